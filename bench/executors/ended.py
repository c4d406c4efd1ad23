"""What an executor reports of a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from .task import Task


class Ended(NamedTuple):
    """A task whose process or job is over; its outcome says how, if it was left one.

    Attributes
    ----------
    lost : what is known of the end where there may be no outcome, "" where it ended of itself.
    again : whether to start it again if there is none.
    """

    task: Task
    lost: str = ""
    again: bool = True


class Executor(Protocol):
    """Works on tasks somewhere."""

    @property
    def running(self) -> int:
        """How many tasks are worked on."""

    def submit(self, tasks: Sequence[Task]) -> None:
        """Have these tasks worked on."""

    def poll(self, seconds: float) -> list[Ended]:
        """Wait for news, at most so long; return the tasks that ended since."""

    def close(self) -> None:
        """Let go of what is held here; called once, however it ended."""
