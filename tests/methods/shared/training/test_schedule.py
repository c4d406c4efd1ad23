"""Schedules against the published moments and what short runs need."""

from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.methods.shared.config import SplatTraining
from headbench.methods.shared.schedule import DensifySchedule, Timeline, log_linear

PUBLISHED = SplatTraining()


def schedule(total, settings=PUBLISHED):
    return DensifySchedule.of(settings, Timeline(total, settings.schedule_length), white=True)


def test_published_length_gives_published_moments():
    published = schedule(600_000)
    rounds = [i for i in range(1, 600_001) if published.is_round(i)]
    assert rounds == list(range(12_000, 600_000, 2_000))
    resets = [i for i in range(1, 600_001) if published.is_reset(i)]
    assert resets == [10_000, *range(60_000, 600_000, 60_000)]
    assert not published.prunes_large(60_000)
    assert published.prunes_large(60_001)


@pytest.mark.parametrize("total", [60_000, 120_000])
def test_a_shorter_run_follows_the_same_course(total):
    long, short = schedule(600_000), schedule(total)
    factor = 600_000 // total
    assert short.start * factor == long.start
    assert short.every * factor == long.every
    assert short.reset_every * factor == long.reset_every
    assert short.prune_extent_from * factor == long.prune_extent_from


@given(st.integers(1, 5_000))
def test_short_runs_keep_the_minimum_intervals(total):
    short = schedule(total)
    rounds = [i for i in range(1, total + 1) if short.is_round(i)]
    assert all(b - a >= PUBLISHED.min_densify_every for a, b in pairwise(rounds))
    assert all(total - i >= PUBLISHED.min_settle for i in rounds)
    resets = [i for i in range(1, total + 1) if short.is_reset(i)]
    if total <= PUBLISHED.min_reset_every:
        assert resets == []
    assert all(total - i >= PUBLISHED.min_settle for i in resets)


def test_log_linear_ends_and_middle():
    assert log_linear(5e-3, 5e-5, 0.0) == pytest.approx(5e-3)
    assert log_linear(5e-3, 5e-5, 1.0) == pytest.approx(5e-5)
    assert log_linear(5e-3, 5e-5, 0.5) == pytest.approx(5e-4)
    assert log_linear(5e-3, 5e-5, 2.0) == pytest.approx(5e-5)


def test_intervals_never_vanish():
    assert Timeline(10, 600_000).every(1_000) == 1
    assert Timeline(10, 600_000).every(1_000, 100) == 100


def test_opacities_that_are_never_reset():
    never = replace(PUBLISHED, reset_every=None, reset_at_start=False)
    schedule = DensifySchedule.of(never, Timeline(600_000, 600_000), white=True)
    assert not any(schedule.is_reset(iteration) for iteration in range(1, 600_001, 500))
    once = DensifySchedule.of(replace(never, reset_at_start=True), Timeline(600_000, 600_000), white=True)
    assert once.is_reset(10_000)
