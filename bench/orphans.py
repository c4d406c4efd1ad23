"""Ends processes that a program left behind, in any session."""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import psutil

PATIENCE_S = 10.0
"""Seconds of searching for newly started processes."""
_SET_SUBREAPER, _GET_SUBREAPER = 36, 37
"""From linux/prctl.h."""


def set_subreaper(on: bool) -> bool | None:
    """Choose whether this process becomes the parent of descendants whose own parent has ended.

    Returns
    -------
    bool | None
        Previous state; None on systems other than Linux.
    """
    libc, before = ctypes.CDLL(None), ctypes.c_int()
    if not hasattr(libc, "prctl") or libc.prctl(_GET_SUBREAPER, ctypes.byref(before), 0, 0, 0) != 0:
        return None
    return bool(before.value) if libc.prctl(_SET_SUBREAPER, int(on), 0, 0, 0) == 0 else None


def end_orphans(kept: Collection[int]) -> None:
    """Kill children of this process that are in other sessions, except those whose ids are in ``kept``.

    Descendants of a program started in a separate session never have the session of this process, even if they change
    their environment. The children of a killed process are found in the next round.
    """
    import psutil

    until = time.monotonic() + PATIENCE_S
    while (left := [child for child in _orphans() if child.pid not in kept]) and time.monotonic() < until:
        for child in left:
            with suppress(psutil.Error, OSError):
                child.kill()
                os.waitpid(child.pid, os.WNOHANG)
        time.sleep(0.02)


@contextmanager
def orphans_ended() -> Iterator[None]:
    """At the end of the block, kill processes left behind by programs started in it. Requires subreapers (Linux)."""
    before = {child.pid for child in _orphans()}
    earlier = set_subreaper(True)
    try:
        yield
    finally:
        if earlier is not None:
            end_orphans(before)
            set_subreaper(earlier)


def _orphans() -> list[psutil.Process]:
    """Children of this process in other sessions."""
    import psutil

    found, own = [], os.getsid(0)
    for child in psutil.Process().children():
        with suppress(ProcessLookupError):
            if os.getsid(child.pid) != own:
                found.append(child)
    return found
