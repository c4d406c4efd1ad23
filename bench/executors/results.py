"""Results of tasks, and the interface of executors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from .task import Task


class TaskResult(NamedTuple):
    """A task whose process or job has ended; its outcome file, if any, records how.

    Attributes
    ----------
    lost : str
        Reason why the outcome file may be missing; "" after a regular end.
    again : bool
        Whether to restart the task if there is no outcome.
    """

    task: Task
    lost: str = ""
    again: bool = True


class Executor(Protocol):
    """Runs tasks: in this process, in workers, or on Slurm."""

    @property
    def running(self) -> Sequence[Task]:
        """The running tasks."""

    def submit(self, tasks: Sequence[Task]) -> None:
        """Start these tasks."""

    def poll(self, seconds: float) -> list[TaskResult]:
        """Wait at most ``seconds`` for tasks to end; return the results of those that ended."""

    def close(self) -> None:
        """Release processes and jobs; called once, also after an error."""
