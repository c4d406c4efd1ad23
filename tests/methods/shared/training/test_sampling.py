"""Samplers: what they draw, and that they remember nothing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from headbench.methods.shared.schedule import BLOCK, ShuffledEpochs, Weighted, balanced_weights


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


def test_classes_have_equal_shares():
    # Timesteps 0, 1, 2 are of class 0, timestep 3 of class 1; two cameras each.
    timesteps = np.repeat([0, 1, 2, 3], 2)
    weights = balanced_weights(timesteps, {0: 0, 1: 0, 2: 0, 3: 1})
    np.testing.assert_allclose(weights, [1 / 3] * 6 + [1] * 2)
    assert weights[:6].sum() == pytest.approx(weights[6:].sum())


@given(labels=st.lists(st.integers(0, 5), min_size=1, max_size=40))
def test_every_class_has_the_same_share(labels):
    weights = balanced_weights(np.arange(len(labels)), dict(enumerate(labels)))
    probabilities = weights / weights.sum()
    classes = set(labels)
    for label in classes:
        members = probabilities[np.array(labels) == label]
        assert members.sum() == pytest.approx(1 / len(classes))
        assert np.ptp(members) == 0
