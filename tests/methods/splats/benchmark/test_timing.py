import itertools

import pytest

from headbench.methods.splats.benchmark.timing import repeat, summarise


def test_summary_of_known_runs():
    times = summarise([5.0, 1.0, 2.0, 3.0, 4.0])
    assert (times.least, times.median, times.iqr, times.runs) == (1.0, 3.0, 2.0, 5)


def test_the_first_run_only_warms_up_and_the_clock_is_the_one_given():
    ticks = itertools.count()
    costs = iter([100, 3, 1, 2])

    def frame(clock):
        cost = next(costs)
        return clock() + cost, clock() + 2 * cost

    forward, both = repeat(frame, budget=0, least_runs=3, clock=lambda: 0 * next(ticks))
    assert (forward.least, both.least, forward.runs, both.runs) == (1, 2, 3, 3)
    assert next(ticks) == 8


def test_runs_go_on_for_the_budget():
    forward, _ = repeat(lambda clock: (clock(), clock()), budget=0.02, least_runs=1)
    assert forward.runs > 1
    assert forward.least == pytest.approx(forward.median, abs=1)
