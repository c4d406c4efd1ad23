"""What the viewer needs of a live signal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from ...bench.contracts import HeadPose

LIVE = "live signal"
"""Name of the live signal among recordings."""


class LiveSource(Protocol):
    """Where live poses come from, see `live.LivePoses`."""

    def pose(self, version: str) -> HeadPose | None:
        """The latest pose of a head model; None before the first."""

    def listen(self, listener: Callable[[], None]) -> None:
        """Call ``listener`` after each new pose."""

    def forget(self, listener: Callable[[], None]) -> None:
        """Call ``listener`` no more."""
