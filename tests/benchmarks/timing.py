"""Timing of benchmarks: runs repeated or in turns, torch on a number of threads, and tables of what was found."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Times:
    """Seconds of repeated runs of one thing. The least is what the code costs; the rest is the machine's."""

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


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Align columns: text to the left, columns whose cells all begin with a digit, a sign or a dash to the right."""
    cells = [list(header), *map(list, rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(header))]
    numeric = [all(row[k][:1] in "-+.0123456789" for row in rows) for k in range(len(header))]
    lines = [
        "  ".join(
            text.rjust(width) if right else text.ljust(width)
            for text, width, right in zip(row, widths, numeric, strict=True)
        ).rstrip()
        for row in cells
    ]
    return "\n".join([lines[0], "  ".join("-" * width for width in widths), *lines[1:]])


def milliseconds(seconds: float) -> str:
    """Seconds as milliseconds with one decimal."""
    return f"{1e3 * seconds:.1f}"


def seconds_of(
    run: Callable[[], object], clock: Callable[[], float] = time.perf_counter
) -> Callable[[], float]:
    """A function that runs something and returns the seconds it took."""

    def timed() -> float:
        start = clock()
        run()
        return clock() - start

    return timed


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Torch on ``count`` threads; with one its own work counts to the thread that is timed."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
