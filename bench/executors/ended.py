"""What an executor tells of a cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from .worker import Work


class Ended(NamedTuple):
    """A cell whose process or job is over; its outcome says how, if it was left one.

    Attributes
    ----------
    lost : what is known of the end where there may be no outcome, "" where it ended of itself.
    again : whether to start it again if there is none.
    """

    work: Work
    lost: str = ""
    again: bool = True


class Executor(Protocol):
    """Works on cells somewhere."""

    @property
    def running(self) -> int:
        """How many cells are worked on."""

    def submit(self, works: Sequence[Work]) -> None:
        """Have these cells worked on."""

    def poll(self, seconds: float) -> list[Ended]:
        """Wait for news, at most so long; return the cells that ended since."""

    def close(self) -> None:
        """Let go of what is held here; called once, however it ended."""
