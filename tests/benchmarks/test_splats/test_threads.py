"""Timing of threads: who is confined where, what the figures are made of, and that nothing is left running."""

import os
import time

import pytest

from headbench.methods.splats import available_backends
from headbench.tests.benchmarks.splats import threads
from headbench.tests.benchmarks.splats.passes import draw, leaves
from headbench.tests.benchmarks.splats.scenes import cloud
from headbench.tests.benchmarks.splats.threads import Scaling, measure_threads, one_core_busy, threads_table

needs_two_cores = pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2,
    reason="takes Linux and two cores",
)
needs_kernel = pytest.mark.skipif(
    "cpu" not in available_backends(), reason="the splat kernel is not installed: no C++ compiler was found"
)


def _allowed():
    return {
        thread: os.sched_getaffinity(int(thread))
        for thread in os.listdir("/proc/self/task")
        if os.path.exists(f"/proc/self/task/{thread}")
    }


def _children():
    """Processor seconds and cores of this process's children, by process id."""
    found = {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{name}/stat") as stream:
                fields = stream.read().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == os.getpid():
            seconds = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
            found[int(name)] = seconds, os.sched_getaffinity(int(name))
    return found


@needs_two_cores
@needs_kernel
def test_a_core_is_busy_inside_and_free_again_after():
    scene = cloud(50, 64, 64)
    draw(scene, leaves(scene), backend="cpu", threads=3)  # so that the kernel's threads are there
    before, children = _allowed(), set(_children())
    with one_core_busy() as arranged:
        assert arranged
        confined = set.union(*_allowed().values())
        assert len(confined) == 2, "every thread of the process is on the same two cores"
        time.sleep(0.5)
        ((seconds, cores),) = [of for process, of in _children().items() if process not in children]
        assert seconds > 0.1
        assert len(cores) == 1
        assert cores < confined
    assert set(_children()) == children
    assert {thread: cores for thread, cores in _allowed().items() if thread in before} == before


@needs_two_cores
def test_a_failure_inside_leaves_nothing_running():
    before, children = _allowed(), set(_children())
    with pytest.raises(RuntimeError, match="inside"), one_core_busy():
        raise RuntimeError("inside")
    assert set(_children()) == children
    assert _allowed() == before


@needs_kernel
def test_without_two_cores_there_is_no_busy_measurement(monkeypatch):
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda _: {0}, raising=False)
    scaling = measure_threads(cloud(100, 40, 30), budget=0, least_runs=2)
    assert scaling.busy_one_thread is None
    assert scaling.busy_two_threads is None
    assert 0 < scaling.share < 1.1
    assert threads_table([scaling]).split("\n")[-1].split()[-3:] == ["-", "-", "-"]


@needs_kernel
def test_figures_are_least_when_idle_and_median_when_busy(monkeypatch):
    taken = iter([{1: [4.0, 2.0, 3.0], 2: [2.0, 1.0, 9.0]}, {1: [5.0, 2.0, 4.0], 2: [6.0, 1.0, 5.0]}])
    monkeypatch.setattr(threads, "take_turns", lambda runs, **_: next(taken))
    scaling = measure_threads(cloud(100, 40, 30), budget=0, least_runs=2)
    assert (scaling.one_thread, scaling.two_threads) == (2.0, 1.0)
    if scaling.busy_one_thread is not None:
        assert (scaling.busy_one_thread, scaling.busy_two_threads) == (4.0, 5.0)


def test_the_table_shows_the_ratios():
    row = threads_table([Scaling(7, 30, 20, 0.3, 0.2, 0.5, None, 0.25, 0.3)]).split("\n")[-1]
    assert row.split() == ["7", "30x20", "300.0", "200.0", "1.50", "50", "%", "-", "250.0", "300.0", "1.20"]
