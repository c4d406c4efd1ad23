"""Two threads against one: on the machine as it is, and while another process keeps one of two cores busy.

Threads are timed by the wall, so whatever else the machine does is in the figures. Each row therefore says how busy the
machine was, and runs with one and with two threads take turns.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from ..timing import milliseconds, table, take_turns
from .scenes import Scene, passes

# Ends with its parent, whose number is its second argument: a benchmark that is killed leaves nothing running.
_SPIN = """
import os, sys
os.sched_setaffinity(0, {int(sys.argv[1])})
print("spinning", flush=True)
while os.getppid() == int(sys.argv[2]):
    for _ in range(100_000):
        pass
"""


@dataclass(frozen=True)
class Scaling:
    """Wall seconds of both passes with one and with two threads."""

    splats: int
    width: int
    height: int
    one_thread: float
    """Least of the runs: what an idle machine needs, if it was idle at any time."""
    two_threads: float
    share: float
    """Processor time over wall time of the runs with one thread: 1 where nothing else wanted the core."""
    load: float | None
    """The machine's load average over the minute before, or None where it has none."""
    busy_one_thread: float | None
    """Median of the runs on two cores, of which another process keeps one busy; None where that cannot be arranged."""
    busy_two_threads: float | None


def measure_threads(scene: Scene, *, budget: float, least_runs: int) -> Scaling:
    """Time one and two threads in turn for ``budget`` seconds, and as long again with one core busy."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    processor: list[float] = []
    runs = {threads: _wall(scene, threads, processor if threads == 1 else []) for threads in (1, 2)}
    idle = take_turns(runs, budget=budget, least_runs=least_runs)
    share = sum(processor[-len(idle[1]) :]) / sum(idle[1])
    busy: dict[int, float | None] = {1: None, 2: None}
    with one_core_busy() as arranged:
        if arranged:
            taken = take_turns(runs, budget=budget, least_runs=least_runs)
            busy = {threads: median(seconds) for threads, seconds in taken.items()}
    size = (len(scene.means), scene.width, scene.height)
    return Scaling(*size, min(idle[1]), min(idle[2]), share, load, busy[1], busy[2])


@contextmanager
def one_core_busy() -> Iterator[bool]:
    """Confine this process to two cores and keep one of them busy with another process.

    Gives False, and does nothing, where there are not two cores or a process cannot be confined to some (it takes
    Linux).
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if len(cores) < 2 or not Path("/proc/self/task").is_dir():
        yield False
        return
    spinner = None
    try:
        _confine(cores[:2])
        spinner = subprocess.Popen(
            [sys.executable, "-S", "-c", _SPIN, str(cores[0]), str(os.getpid())], stdout=subprocess.PIPE
        )
        assert spinner.stdout is not None
        yield spinner.stdout.readline() == b"spinning\n"
    finally:
        if spinner is not None:
            spinner.kill()
            spinner.communicate()
        _confine(cores)


def threads_table(scaling: Sequence[Scaling]) -> str:
    """Lay out the results."""
    header = (
        *("splats", "image", "one thread", "two threads", "speed-up", "core's share", "load"),
        *("one, a core busy", "two, a core busy", "two/one"),
    )
    rows = []
    for one in scaling:
        busy = ("-", "-", "-")
        if one.busy_one_thread is not None and one.busy_two_threads is not None:
            ratio = one.busy_two_threads / one.busy_one_thread
            busy = (milliseconds(one.busy_one_thread), milliseconds(one.busy_two_threads), f"{ratio:.2f}")
        rows.append(
            (
                *(str(one.splats), f"{one.width}x{one.height}"),
                *(milliseconds(one.one_thread), milliseconds(one.two_threads)),
                f"{one.one_thread / one.two_threads:.2f}",
                f"{100 * one.share:.0f} %",
                "-" if one.load is None else f"{one.load:.1f}",
                *busy,
            )
        )
    return (
        "Threads. Wall time of both passes, ms: the least of runs that take turns. The share is processor time over "
        "wall time of\none thread, the load that of the minute before: on a busy machine the speed-up says little. To "
        "the right the median while\nanother process keeps one of two cores busy.\n\n" + table(header, rows)
    )


def _wall(scene: Scene, threads: int, processor: list[float]) -> Callable[[], float]:
    """A function that runs both passes and gives the wall seconds; adds the process's seconds to ``processor``."""
    run = passes(scene, "cpu", threads)

    def timed() -> float:
        before, start = time.process_time(), time.perf_counter()
        run(time.perf_counter)
        seconds = time.perf_counter() - start
        processor.append(time.process_time() - before)
        return seconds

    return timed


def _confine(cores: Sequence[int]) -> None:
    """Let every thread of this process, the kernel's pool included, run on these cores only."""
    for thread in os.listdir("/proc/self/task"):
        try:
            os.sched_setaffinity(int(thread), cores)
        except ProcessLookupError:
            continue  # it has ended meanwhile
