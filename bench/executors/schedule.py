"""Runs tasks on an executor: submits them, polls their results and restarts lost tasks; and the executor ``processes``."""

from __future__ import annotations

import logging
import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from ..machine import processor_count
from ..process import environment_variable
from ..progress import TasksLeft, progress
from ..start import end_with_parent, starting_workers
from .outcome import TaskOutcome, forget_outcome, read_outcome, write_outcome
from .results import Executor, TaskResult
from .settings import Execution
from .slurm import Slurm
from .task import TASK_LOG, Task
from .worker import execute_task

STOP_S, POLL_S = 5.0, 1.0
"""Time for a worker to terminate, and between updates of the progress, seconds."""


@dataclass(eq=False)
class _Process:
    process: Any
    connection: Connection
    task: Task | None = None

    def stop(self) -> None:
        """Close the connection, which ends the worker, and kill the worker if it is still alive after `STOP_S`."""
        self.connection.close()
        self.process.join(STOP_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


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
        self._processes: list[_Process] = []

    @property
    def running(self) -> Sequence[Task]:
        """The running tasks."""
        return [process.task for process in self._processes if process.task is not None]

    def submit(self, tasks: Sequence[Task]) -> None:
        """Execute these tasks, in order, after those already queued."""
        for task in tasks:
            forget_outcome(task.folder, task.speed)
        self._waiting.extend(tasks)

    def poll(self, seconds: float) -> list[TaskResult]:
        """Wait at most ``seconds`` for a task to end; return the results of those that ended."""
        self._fill()
        connections = [p.connection for p in self._processes if p.task is not None]
        ready = wait(connections, min(seconds, POLL_S))
        ended = [self._ended(p) for p in list(self._processes) if p.connection in ready]
        self._fill()
        return ended

    def close(self) -> None:
        """Terminate all workers; their tasks resume from checkpoints when started again."""
        for process in self._processes:
            process.process.terminate()
        for process in self._processes:
            process.stop()
        self._processes = []

    def _fill(self) -> None:
        """Assign queued tasks to idle workers."""
        idle = [process for process in self._processes if process.task is None]
        while self._waiting and (idle or len(self._processes) < self._count):
            process = idle.pop() if idle else self._start()
            process.task = self._waiting.popleft()
            process.connection.send(process.task)

    def _ended(self, process: _Process) -> TaskResult:
        assert process.task is not None
        task, process.task = process.task, None
        try:
            error = process.connection.recv()
        except (EOFError, OSError):
            self._processes.remove(process)
            process.process.join()
            process.connection.close()
            return TaskResult(task, f"its process was ended by {_cause(process.process.exitcode)}")
        if error is not None:
            raise error
        outcome = read_outcome(task.folder)
        if task.device != "cpu" and outcome is not None and outcome["status"] == "failed":
            self._processes.remove(process)  # After a CUDA error, all further CUDA calls of its process fail.
            process.stop()
        return TaskResult(task)

    def _start(self) -> _Process:
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.get_context("spawn").Process(target=_serve, args=(theirs,))
        threads = (
            None if self._threads is None else str(self._threads)
        )  # libraries read it when they are imported
        with starting_workers(), environment_variable("OMP_NUM_THREADS", threads):
            process.start()
        theirs.close()
        started = _Process(process, ours)
        self._processes.append(started)
        return started


def _serve(connection: Connection) -> None:
    """Execute tasks until the connection is closed."""
    end_with_parent()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    while True:
        try:
            task: Task = connection.recv()
        except EOFError:
            return
        error = None
        try:
            execute_task(task)
        except Exception as raised:  # noqa: BLE001 - the other process reports it
            error = raised
        connection.send(error)


def _cause(code: int | None) -> str:
    if code is not None and code < 0:
        hint = ", probably out of memory" if -code == signal.SIGKILL else ""
        return f"{signal.Signals(-code).name}{hint}"
    return f"exit code {code}"


log = logging.getLogger(__name__)
DAMAGED = "its results are missing or damaged"
Failures = dict[str, str]
"""Reasons of failed tasks, by their folder."""


@dataclass(frozen=True)
class Schedule:
    """Tasks of one kind.

    Attributes
    ----------
    label : str
        Common name of the tasks in progress messages.
    is_done : Callable
        Whether the results of a task with a successful outcome exist and are complete.
    execution : Execution
        Execution settings; any executor except "inline".
    speed : bool
        Whether the tasks measure speed, one at a time with all threads, see `Task.speed`.
    """

    label: str
    is_done: Callable[[Task], bool]
    execution: Execution
    speed: bool = False

    def run_all(self, tasks: Sequence[Task]) -> Failures:
        """Run the tasks, all of one root folder that the caller has locked; return the failures by folder.

        Raises
        ------
        InputError
            Slurm refuses jobs.
        OSError
            The disk is full or read-only; no task is marked as failed.
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
                for ended in executor.poll(self.execution.poll_s):
                    again = self._again(ended, failures)
                    if again is not None:
                        executor.submit([again])
                    else:
                        done += 1
                        left.end(ended.task.place)
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

    def _again(self, ended: TaskResult, failures: Failures) -> Task | None:
        """The task to submit again after one ended; None if it is done, or failed and recorded as such."""
        task = ended.task
        outcome = read_outcome(task.folder)
        reason = ""
        if outcome is not None and outcome["speed"] == self.speed:
            if outcome["status"] == "done" and self.is_done(task):
                return None
            reason = outcome.get("reason", "") if outcome["status"] == "failed" else ""
        if not reason:
            lost = ended.lost or DAMAGED
            if ended.again and task.restarts < self.execution.restarts:
                log.warning("%s: %s; it is started again", task.place, lost)
                return replace(task, restarts=task.restarts + 1)
            reason = f"HeadbenchError: {lost}" + (f", {task.restarts + 1} times" if task.restarts else "")
            # The process ended before it could record this.
            known: TaskOutcome = outcome or {"status": "failed", "speed": self.speed}
            write_outcome(task.folder, {**known, "status": "failed", "speed": self.speed, "reason": reason})
        failures[task.place] = reason
        log.error("%s failed: %s; see %s", task.place, reason, task.folder / TASK_LOG)
        return None


def _activities(tasks: Sequence[Task]) -> dict[str, str]:
    """What each running task does, by its name, as its process or job has recorded."""
    found = {}
    for task in tasks:
        outcome = read_outcome(task.folder)
        found[task.name or task.place] = "starting" if outcome is None else outcome.get("doing", "starting")
    return found
