"""Runs tasks on an executor: submits them, polls their results and restarts lost tasks."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from ..machine import processor_count
from ..progress import TasksLeft, progress
from .outcome import TaskOutcome, read_outcome, write_outcome
from .processes import Processes
from .results import Executor, TaskResult
from .settings import Execution
from .slurm import Slurm
from .task import TASK_LOG, Task

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
