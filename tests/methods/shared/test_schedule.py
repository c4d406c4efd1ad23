"""Schedules against the published moments and what short runs need."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from headbench.methods.shared.config import SplatTraining
from headbench.methods.shared.schedule import (
    BLOCK,
    RECOVERY,
    DensifySchedule,
    GroupedBatches,
    ShuffledEpochs,
    Timeline,
    Weighted,
    balanced_weights,
    log_linear,
    numpy_generator,
    torch_generator,
)

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
    assert all(total - i >= RECOVERY for i in resets)
    if total <= PUBLISHED.min_reset_every:
        assert resets == []


def test_the_last_iterations_of_a_short_run_have_no_reset():
    assert schedule(3_000 + RECOVERY).is_reset(3_000)
    assert not schedule(3_000 + RECOVERY - 1).is_reset(3_000)


def test_log_linear_ends_and_middle():
    assert log_linear(5e-3, 5e-5, 0.0) == pytest.approx(5e-3)
    assert log_linear(5e-3, 5e-5, 1.0) == pytest.approx(5e-5)
    assert log_linear(5e-3, 5e-5, 0.5) == pytest.approx(5e-4)
    assert log_linear(5e-3, 5e-5, 2.0) == pytest.approx(5e-5)


def test_opacities_that_are_never_reset():
    never = replace(PUBLISHED, reset_every=None, reset_at_start=False)
    schedule = DensifySchedule.of(never, Timeline(600_000, 600_000), white=True)
    assert not any(schedule.is_reset(iteration) for iteration in range(1, 600_001, 500))
    once = DensifySchedule.of(replace(never, reset_at_start=True), Timeline(600_000, 600_000), white=True)
    assert once.is_reset(10_000)


def test_every_image_once_per_epoch_in_an_order_of_its_own():
    sampler = ShuffledEpochs(17, seed=0)
    epochs = [[sampler(1 + 17 * e + i) for i in range(17)] for e in range(4)]
    assert all(sorted(epoch) == list(range(17)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 4


@pytest.mark.parametrize("make", [lambda s: ShuffledEpochs(23, s), lambda s: Weighted(np.arange(1, 24), s)])
def test_a_draw_depends_on_seed_and_iteration_alone(make):
    iterations = np.random.default_rng(0).permutation(5000) + 1
    forward = make(3)
    in_order = {i: forward(i) for i in range(1, 5001)}
    jumping = make(3)
    assert all(jumping(int(i)) == in_order[int(i)] for i in iterations[:400])
    other = make(4)
    assert [other(i) for i in range(1, 50)] != [in_order[i] for i in range(1, 50)]


def test_weighted_draws_follow_their_probabilities():
    weights = np.array([1.0, 0.0, 2.0, 5.0])
    sampler = Weighted(weights, seed=1)
    draws = [sampler(i) for i in range(1, 8 * BLOCK + 1)]
    counts = np.bincount(draws, minlength=4)
    assert counts[1] == 0
    used = [0, 2, 3]
    assert chisquare(counts[used], weights[used] / 8 * len(draws)).pvalue > 1e-3


@given(labels=st.lists(st.integers(0, 5), min_size=1, max_size=40))
def test_every_class_has_the_same_share(labels):
    weights = balanced_weights(np.arange(len(labels)), dict(enumerate(labels)))
    probabilities = weights / weights.sum()
    classes = set(labels)
    for label in classes:
        members = probabilities[np.array(labels) == label]
        assert members.sum() == pytest.approx(1 / len(classes))
        assert np.ptp(members) == 0


def draw(*where):
    return torch.rand(4, generator=torch_generator(*where)).tolist()


def test_equal_places_give_equal_numbers_and_others_do_not():
    places = [(0, "a", 0), (1, "a", 0), (0, "b", 0), (0, "a", 1)]
    assert all(draw(*place) == draw(*place) for place in places)
    assert len({tuple(draw(*place)) for place in places}) == 4
    assert numpy_generator(0, "a").random() != numpy_generator(1, "a").random()


@given(
    groups=st.lists(st.integers(0, 4), min_size=1, max_size=40),
    size=st.integers(1, 7),
    together=st.integers(1, 7),
)
def test_batches_hold_every_image_once_per_epoch(groups, size, together):
    batches = GroupedBatches(groups, size, together, seed=1)
    length = -(-len(groups) // size)
    for epoch in (0, 3):
        numbers = [epoch * length + at + 1 for at in range(length)]
        images = [image for number in numbers for image in batches.batch(number)]
        assert sorted(images) == list(range(len(groups)))
        for number in numbers:
            for at, image in batches.positions(number):
                assert batches(at) == image
            following = batches.positions(number)[-1][0] + 1
            assert batches(following) == batches.batch(number + 1)[0]


def test_batches_share_a_group_where_it_is_large_enough():
    batches = GroupedBatches([0] * 15 + [1] * 15, 4, 4, seed=0)
    shared = [len({image // 15 for image in batches.batch(number)}) == 1 for number in range(1, 9)]
    assert shared[:6] == [True] * 6
