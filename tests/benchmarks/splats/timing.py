"""Timing one frame: processor time of this thread, repeated until it is known."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Times:
    """Seconds of repeated runs of one thing. The least is what the code costs; the rest tells of the machine."""

    least: float
    median: float
    iqr: float
    """Between the quartiles."""
    runs: int


def summarise(seconds: list[float]) -> Times:
    """Reduce the seconds of single runs."""
    low, median, high = np.percentile(seconds, [25, 50, 75])
    return Times(min(seconds), float(median), float(high - low), len(seconds))


def repeat(
    frame: Callable[[Callable[[], float]], tuple[float, float]],
    *,
    budget: float,
    least_runs: int,
    clock: Callable[[], float] = time.thread_time,
) -> tuple[Times, Times]:
    """Run ``frame`` once to warm up, then for about ``budget`` seconds, ``least_runs`` times at the least.

    ``frame`` takes the clock and gives the seconds of its forward pass and of both passes.
    """
    frame(clock)
    forward: list[float] = []
    both: list[float] = []
    start = time.monotonic()
    while len(both) < least_runs or time.monotonic() - start < budget:
        first, whole = frame(clock)
        forward.append(first)
        both.append(whole)
    return summarise(forward), summarise(both)


def take_turns(
    runs: Mapping[Key, Callable[[], float]], *, budget: float, least_runs: int
) -> dict[Key, list[float]]:
    """Seconds of several things to compare, by key: one run of each in turn, so that all see the same machine.

    A first round warms up and does not count. Each of ``runs`` gives its seconds. Goes on for about ``budget`` seconds,
    ``least_runs`` rounds at the least.
    """
    for run in runs.values():
        run()
    seconds: dict[Key, list[float]] = {key: [] for key in runs}
    start, rounds = time.monotonic(), 0
    while rounds < least_runs or time.monotonic() - start < budget:
        for key, run in runs.items():
            seconds[key].append(run())
        rounds += 1
    return seconds
