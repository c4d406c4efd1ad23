import itertools

import pytest

from headbench.tests.benchmarks.splats.timing import repeat, summarise, take_turns


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


def test_runs_take_turns_after_a_round_that_does_not_count():
    log = []

    def of(name, costs):
        costs = iter(costs)

        def run():
            log.append(name)
            return next(costs)

        return run

    runs = {"a": of("a", [9.0, 1.0, 2.0]), "b": of("b", [9.0, 3.0, 4.0])}
    assert take_turns(runs, budget=0, least_runs=2) == {"a": [1.0, 2.0], "b": [3.0, 4.0]}
    assert log == ["a", "b"] * 3


def test_turns_go_on_for_the_budget():
    taken = take_turns({1: lambda: 0.5}, budget=0.02, least_runs=1)
    assert len(taken[1]) > 1
