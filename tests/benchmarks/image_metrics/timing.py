"""Times of several ways to one number, taken in turns in one run, so that a busy machine slows them alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Timed:
    """One way: its value, and the least processor and wall time of a run, milliseconds per image."""

    name: str
    value: float
    processor_ms: float
    wall_ms: float


def in_turns(ways: Mapping[str, Callable[[], float]], runs: int, images: int) -> list[Timed]:
    """Run every way ``runs`` times, one after the other; each run scores ``images`` images."""
    least = {name: (float("inf"), float("inf")) for name in ways}
    values: dict[str, float] = {}
    for _ in range(runs):
        for name, way in ways.items():
            processor, wall = time.process_time(), time.perf_counter()
            values[name] = way()
            spent = time.process_time() - processor, time.perf_counter() - wall
            least[name] = min(least[name][0], spent[0]), min(least[name][1], spent[1])
    return [Timed(name, values[name], *(1e3 * t / images for t in least[name])) for name in ways]
