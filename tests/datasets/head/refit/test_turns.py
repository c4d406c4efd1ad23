"""Rotations against scipy, their derivatives against differences, at zero and at half a turn too."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headbench.datasets.head.rotations import axis_angles, matrices, matrices_and_derivatives

DIAGONAL = np.ones(3) / np.sqrt(3)
VECTORS = [
    *(np.zeros(3), 1e-12 * DIAGONAL, 1e-5 * DIAGONAL, 0.0999 * DIAGONAL, 0.1001 * DIAGONAL),
    *(np.array([0.3, -0.2, 0.9]), np.array([np.pi, 0, 0]), np.pi * DIAGONAL, np.array([0, 2 * np.pi, 0])),
]


@pytest.mark.parametrize("vector", VECTORS, ids=str)
def test_matrices_and_derivatives(vector):
    rotation, derivative = matrices_and_derivatives(vector[None])
    np.testing.assert_allclose(rotation[0], Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(matrices(vector[None]), rotation, atol=1e-15)
    step = 1e-6
    for axis in range(3):
        either = [matrices(vector[None] + side * step * np.eye(3)[axis])[0] for side in (1, -1)]
        numeric = (either[0] - either[1]) / (2 * step)
        np.testing.assert_allclose(derivative[0, :, :, axis], numeric, atol=1e-9)


def test_the_way_back():
    vectors = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(axis_angles(matrices(vectors)), vectors, atol=1e-12)
