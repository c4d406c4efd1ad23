"""Jaw bases against brute force and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from headbench.bench.contracts import FrameKey
from headbench.datasets.steps.clusters import (
    HALF_TURN,
    IDENTITY,
    farthest_quaternions,
    jaw_bases,
    jaw_quaternions,
    jaw_weights,
)

from .clips import make_clip, with_poses

seeds = st.integers(0, 2**32 - 1)


def unit_quaternions(count: int, seed: int) -> np.ndarray:
    quaternions = np.random.default_rng(seed).normal(size=(count, 4))
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def brute_force_farthest(candidates, seed, count):
    """The definition, with loops: the candidate whose nearest chosen one is farthest."""
    chosen = [np.array(seed)]
    while len(chosen) < count:
        best = max(range(len(candidates)), key=lambda i: min(1 - abs(candidates[i] @ q) for q in chosen))
        chosen.append(candidates[best])
    return np.array(chosen)


@settings(deadline=None)
@given(seed=seeds, count=st.integers(1, 12))
def test_sampling_equals_brute_force(seed, count):
    candidates = unit_quaternions(40, seed)
    found = farthest_quaternions(candidates, IDENTITY, count)
    np.testing.assert_array_equal(found, brute_force_farthest(candidates, IDENTITY, count))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 3.1, np.pi])
def test_quaternion_of_a_jaw_opening_in_closed_form(angle):
    clip = with_poses(make_clip(1), jaw=lambda t: np.array([angle, 0, 0]))
    expected = [[np.cos(angle / 2), np.sin(angle / 2), 0, 0]]
    np.testing.assert_allclose(jaw_quaternions([clip.poses[0]]), expected, atol=1e-15)


def test_bases_are_identity_and_training_poses_alone():
    clip = make_clip(30, test=10)
    bases = jaw_bases(clip, 8)
    np.testing.assert_array_equal(bases[0], IDENTITY)
    train = jaw_quaternions([clip.poses[t] for t in range(30)])
    assert all((basis == train).all(axis=1).any() for basis in bases[1:])
    changed = with_poses(clip, jaw=lambda t: clip.poses[t].jaw if t < 30 else np.array([1.0, t, 0]))
    np.testing.assert_array_equal(jaw_bases(changed, 8), bases)


def test_no_more_bases_than_distinct_rotations():
    angles = np.radians([0.0, 0.1, 5.0, 5.1, 10.0])  # within a quarter of a degree there are three
    clip = with_poses(make_clip(50), jaw=lambda t: np.array([angles[t % 5], 0, 0]))
    bases = jaw_bases(clip, 16)
    assert len(bases) == 3
    np.testing.assert_allclose(sorted(2 * np.degrees(np.arccos(bases[:, 0]))), [0, 5, 10], atol=0.11)
    still = with_poses(make_clip(5), jaw=lambda t: np.zeros(3))
    np.testing.assert_array_equal(jaw_bases(still, 16), [IDENTITY])


def test_published_bases_are_held_out_poses_and_a_half_turn():
    clip = make_clip(10, test=0)
    cameras = [f"{i:02d}" for i in range(8)]  # every 16th frame is then every second timestep
    test = tuple(FrameKey("s", "q", t, c) for t in range(10, 14) for c in cameras)
    poses = make_clip(10, test=4).poses
    clip = clip.derive("test", {}, splits={**clip.splits, "self_reenactment": test}, poses=poses)
    bases = jaw_bases(clip, 13, variant="official")
    candidates = jaw_quaternions([poses[t] for t in [*range(10), 10, 12]])
    np.testing.assert_array_equal(bases, brute_force_farthest(candidates, HALF_TURN, 13))


@settings(deadline=None)
@given(quaternions=arrays(float, (7, 4), elements=st.floats(-1, 1)), seed=seeds)
def test_weights_are_the_formula_and_blind_to_sign(quaternions, seed):
    quaternions = quaternions + np.array([2.0, 0, 0, 0])
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    bases = unit_quaternions(5, seed)
    weights = jaw_weights(quaternions, bases)
    for q, row in zip(quaternions, weights):
        likeness = [abs(float(np.dot(q, b))) for b in bases]
        np.testing.assert_allclose(row, np.array(likeness) / sum(likeness), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-12)
    np.testing.assert_array_equal(jaw_weights(-quaternions, bases), weights)
