"""Runs tasks on an executor: submits them, polls their results and restarts lost tasks; and the executor ``processes``."""

from __future__ import annotations

import logging
import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from ..engine.store import TaskOutcome, read_outcome, update_record
from ..machine import environment_variable, processor_count
from ..progress import TasksLeft, progress
from ..start import end_with_parent, starting_workers
from .settings import Execution
from .slurm import Slurm
from .task import DAMAGED, TASK_LOG, Executor, Task, TaskResult, execute_task, forget_outcome

POLL_S = 1.0
"""Seconds between updates of the progress."""
log = logging.getLogger(__name__)
Failures = dict[str, str]
"""Reasons of failed tasks, by their folder."""


class _Slot:
    """A worker process, which executes one task after another; a killed one breaks only its own pool."""

    def __init__(self, threads: int | None):
        # Libraries read the variable when they are imported. The pool starts its process when it is first used.
        number = None if threads is None else str(threads)
        before = {*multiprocessing.active_children()}
        context = multiprocessing.get_context("spawn")
        self.pool = ProcessPoolExecutor(1, context, _start_worker)
        with starting_workers(), environment_variable("OMP_NUM_THREADS", number):
            self.pool.submit(int)
        (self.process,) = {*multiprocessing.active_children()} - before
        self.task: Task | None = None
        self.future: Future[None] = Future()

    def execute(self, task: Task) -> None:
        self.task, self.future = task, self.pool.submit(execute_task, task)


class Processes:
    """Workers that execute tasks one after another; a killed worker is replaced.

    Parameters
    ----------
    workers : int
        Maximum number of concurrent workers.
    threads : int | None
        Threads of each worker; None uses the number of this process.
    """

    def __init__(self, workers: int, threads: int | None):
        self._count, self._threads = workers, threads
        self._waiting: deque[Task] = deque()
        self._slots: list[_Slot] = []

    @property
    def running(self) -> Sequence[Task]:
        """The running tasks."""
        return [slot.task for slot in self._slots if slot.task is not None]

    def submit(self, tasks: Sequence[Task]) -> None:
        """Execute these tasks, in order, after those already queued."""
        for task in tasks:
            forget_outcome(task.folder, task.speed)
        self._waiting.extend(tasks)
        self._fill()

    def poll(self, seconds: float) -> list[TaskResult]:
        """Wait at most ``seconds`` for a task to end; return the results of those that ended."""
        busy = [slot for slot in self._slots if slot.task is not None]
        done = wait([slot.future for slot in busy], min(seconds, POLL_S), FIRST_COMPLETED).done
        results = [self._result(slot) for slot in busy if slot.future in done]
        self._fill()
        return results

    def close(self) -> None:
        """Terminate all workers; their tasks resume from checkpoints when started again."""
        for slot in self._slots:
            slot.process.terminate()
        for slot in self._slots:
            slot.pool.shutdown()
        self._slots = []

    def _fill(self) -> None:
        """Assign queued tasks to idle workers."""
        while self._waiting:
            slot = next((slot for slot in self._slots if slot.task is None), None)
            if slot is None:
                if len(self._slots) == self._count:
                    return
                slot = _Slot(self._threads)
                self._slots.append(slot)
            try:
                slot.execute(self._waiting[0])
            except BrokenProcessPool:  # killed while it was idle
                self._remove(slot)
            else:
                self._waiting.popleft()

    def _result(self, slot: _Slot) -> TaskResult:
        assert slot.task is not None
        task, slot.task = slot.task, None
        try:
            slot.future.result()
        except BrokenProcessPool:
            self._remove(slot)
            return TaskResult(task, f"its process was ended by {_cause(slot.process.exitcode)}")
        outcome = read_outcome(task.folder)
        if task.device != "cpu" and outcome is not None and outcome["status"] == "failed":
            self._remove(slot)  # after a CUDA error, all further CUDA calls of its process fail
        return TaskResult(task)

    def _remove(self, slot: _Slot) -> None:
        self._slots.remove(slot)
        slot.pool.shutdown()


def _start_worker() -> None:
    end_with_parent()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _cause(code: int | None) -> str:
    if code is not None and code < 0:
        hint = ", probably out of memory" if -code == signal.SIGKILL else ""
        return f"{signal.Signals(-code).name}{hint}"
    return f"exit code {code}"


@dataclass(frozen=True)
class Schedule:
    """Tasks of one kind."""

    label: str
    """Common name of the tasks in progress messages."""
    is_done: Callable[[Task], bool]
    """Whether the results of a task with a successful outcome exist and are complete."""
    execution: Execution
    """Execution settings, with the executor "processes" or "slurm"."""
    speed: bool = False
    """Whether the tasks measure speed, one at a time with all threads, see `Task.speed`."""

    def run_all(self, tasks: Sequence[Task]) -> Failures:
        """Run the tasks, all of one root folder that the caller has locked; return the failures by folder.

        A full or read-only disk is an `OSError`, and no task is marked as failed.
        """
        failures: Failures = {}
        if not tasks:
            return failures
        executor = self._executor(Path(tasks[0].root), len(tasks), tasks[0].device)
        left = TasksLeft({task.place: task.cost for task in tasks})
        with closing(executor), progress(self.label, left) as report:
            executor.submit(tasks)
            done = 0
            while done < len(tasks):
                for result in executor.poll(self.execution.poll_s):
                    again = self._again(result, failures)
                    if again is not None:
                        executor.submit([again])
                    else:
                        done += 1
                        left.end(result.task.place)
                running = executor.running
                left.running([task.place for task in running])
                note = f"{len(running)} running" + (f", {len(failures)} failed" if failures else "")
                report(done, len(tasks), note, partial(_activities, running))
        return failures

    def _executor(self, root: Path, tasks: int, device: str) -> Executor:
        if self.execution.executor == "slurm":
            return Slurm(root, self.execution, self.speed)
        if self.speed:
            return Processes(1, None)
        cores = processor_count()
        workers = min(self.execution.workers or (cores if device == "cpu" else 1), tasks)
        return Processes(workers, self.execution.threads or max(1, cores // workers))

    def _again(self, result: TaskResult, failures: Failures) -> Task | None:
        """The task to submit again after one ended; None if it is done, or failed and recorded as such."""
        task = result.task
        outcome = read_outcome(task.folder)
        reason = ""
        if outcome is not None and outcome["speed"] == self.speed:
            if outcome["status"] == "done" and self.is_done(task):
                return None
            reason = outcome.get("reason", "") if outcome["status"] == "failed" else ""
        if not reason:
            lost = result.lost or DAMAGED
            if result.again and task.restarts < self.execution.restarts:
                log.warning("%s: %s; it is started again", task.place, lost)
                return replace(task, restarts=task.restarts + 1)
            reason = f"HeadbenchError: {lost}" + (f", {task.restarts + 1} times" if task.restarts else "")
            # The process ended before it could record this.
            failed: TaskOutcome = {"status": "failed", "speed": self.speed, "reason": reason}
            update_record(task.folder, task={**(outcome or failed), **failed})
        failures[task.place] = reason
        log.error("%s failed: %s; see %s", task.place, reason, task.folder / TASK_LOG)
        return None


def _activities(tasks: Sequence[Task]) -> dict[str, str]:
    """What each running task does, by its name, as its process or job has recorded."""
    steps = {}
    for task in tasks:
        outcome = read_outcome(task.folder)
        steps[task.name or task.place] = "starting" if outcome is None else outcome.get("doing", "starting")
    return steps
