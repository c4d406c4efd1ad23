"""Rigid alignment against motions that are known, and against scipy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headbench.datasets.head.geometry import rigid_alignment


def points(count=20, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3))


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 40.0, 180.0])
def test_a_rigid_motion_is_found(degrees):
    turn = Rotation.from_rotvec(degrees * np.array([0.6, 0.0, 0.8]), degrees=True).as_matrix()
    shift = np.array([0.1, -2.0, 3.0])
    motion = rigid_alignment(points(), points() @ turn.T + shift)
    np.testing.assert_allclose(motion[:3, :3], turn, atol=1e-12)
    np.testing.assert_allclose(motion[:3, 3], shift, atol=1e-12)
    np.testing.assert_array_equal(motion[3], [0, 0, 0, 1])


def test_weights_equal_scipys():
    here, there = points(), points(seed=1)
    weights = np.random.default_rng(2).random(len(here))
    middle, there_middle = (np.average(x, axis=0, weights=weights) for x in (here, there))
    turn, _ = Rotation.align_vectors(there - there_middle, here - middle, weights=weights)
    motion = rigid_alignment(here, there, weights)
    np.testing.assert_allclose(motion[:3, :3], turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(motion[:3, :3] @ middle + motion[:3, 3], there_middle, atol=1e-12)


def test_a_mirror_image_is_met_by_a_rotation():
    motion = rigid_alignment(points(), points() * [-1, 1, 1])
    assert np.linalg.det(motion[:3, :3]) == pytest.approx(1)
