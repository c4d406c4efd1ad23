"""Rotations against scipy, and gradients where textbook formulae have none."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from headbench.datasets.head import rotations
from headbench.datasets.head.rotations import matrices_and_derivatives

AXES = np.concatenate([np.eye(3), -np.eye(3), Rotation.random(20, random_state=0).apply([0.0, 0.0, 1.0])])
SMALL = (0.0, 1e-12, 1e-7, 1e-4, 0.03, 0.06, 0.07, 0.19, 0.21)
ANGLES = (*SMALL, 1.0, 2.5, *(np.pi - np.array([1e-3, 1e-7, 1e-12])))
VECTORS = np.concatenate([AXES * angle for angle in ANGLES])


def close(actual, expected, atol=0.0, rtol=0.0, **options):
    """Like numpy's, without its default relative tolerance of 1e-7."""
    np.testing.assert_allclose(actual, expected, atol=atol, rtol=rtol, **options)


def quaternions_wxyz(rotation: Rotation) -> np.ndarray:
    quaternion = rotation.as_quat()[:, [3, 0, 1, 2]]
    return np.where(quaternion[:, :1] < 0, -quaternion, quaternion)


def test_axis_angle_to_matrix_agrees_with_scipy():
    vectors = np.concatenate([VECTORS, AXES * 9.7])
    ours = rotations.axis_angle_to_matrix(torch.from_numpy(vectors))
    close(ours, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-13)


def test_small_rotations_keep_relative_precision_in_float32():
    vectors = torch.tensor([[1e-6, -2e-6, 5e-7]])
    matrix = rotations.axis_angle_to_matrix(vectors)[0]
    close(matrix[2, 1].item(), 1e-6, rtol=1e-6)
    back = rotations.quaternion_to_axis_angle(rotations.axis_angle_to_quaternion(vectors))
    close(back, vectors, rtol=1e-6)


def test_axis_angle_to_quaternion_agrees_with_scipy():
    ours = rotations.axis_angle_to_quaternion(torch.from_numpy(VECTORS))
    close(ours, quaternions_wxyz(Rotation.from_rotvec(VECTORS)), atol=1e-14)


def test_quaternion_to_axis_angle_agrees_with_scipy():
    vectors = VECTORS[np.linalg.norm(VECTORS, axis=1) < np.pi - 1e-9]  # at pi the sign of the axis is free
    quaternion = torch.from_numpy(quaternions_wxyz(Rotation.from_rotvec(vectors)))
    close(rotations.quaternion_to_axis_angle(3.7 * quaternion), vectors, atol=1e-13)
    close(rotations.quaternion_to_axis_angle(-quaternion), vectors, atol=1e-13)


def test_matrix_conversions_agree_with_scipy():
    rotation = Rotation.concatenate([Rotation.from_rotvec(VECTORS), Rotation.random(200, random_state=1)])
    matrix = torch.from_numpy(rotation.as_matrix())
    ours = rotations.matrix_to_quaternion(matrix)
    dots = np.abs((ours.numpy() * quaternions_wxyz(rotation)).sum(1))  # equal up to sign
    close(dots, 1, atol=1e-14)
    close(rotations.quaternion_to_matrix(ours), matrix, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.19, 0.21, 2.0, 3.1])
def test_gradients_are_right(angle):
    vectors = torch.from_numpy(AXES[:9] * angle).requires_grad_()
    assert torch.autograd.gradcheck(rotations.axis_angle_to_matrix, vectors, atol=1e-7)
    assert torch.autograd.gradcheck(rotations.axis_angle_to_quaternion, vectors, atol=1e-7)
    quaternion = rotations.axis_angle_to_quaternion(vectors).detach().requires_grad_()
    assert torch.autograd.gradcheck(rotations.quaternion_to_axis_angle, quaternion, atol=1e-6)
    assert torch.autograd.gradcheck(rotations.quaternion_to_matrix, quaternion, atol=1e-7)


def test_second_derivatives_at_zero():
    zero = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(rotations.axis_angle_to_matrix, zero, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_everywhere(dtype):
    def gradient_is_finite(output, source):
        return bool(torch.isfinite(torch.autograd.grad(output.sum(), source)[0]).all())

    vectors = torch.from_numpy(VECTORS).to(dtype).requires_grad_()
    matrix = rotations.axis_angle_to_matrix(vectors)
    assert gradient_is_finite(matrix, vectors)
    assert gradient_is_finite(
        rotations.matrix_to_quaternion(rotations.axis_angle_to_matrix(vectors)), vectors
    )
    half_turns = torch.diag_embed(2 * torch.eye(3, dtype=dtype) - 1).requires_grad_()
    assert gradient_is_finite(rotations.matrix_to_quaternion(half_turns), half_turns)
    zero = torch.zeros(4, dtype=dtype, requires_grad=True)
    assert gradient_is_finite(rotations.quaternion_to_matrix(zero), zero)
    assert gradient_is_finite(rotations.quaternion_to_axis_angle(zero), zero)


DIAGONAL = np.ones(3) / np.sqrt(3)
SPECIAL_VECTORS = [
    *(np.zeros(3), 1e-12 * DIAGONAL, 1e-5 * DIAGONAL, 0.0999 * DIAGONAL, 0.1001 * DIAGONAL),
    *(np.array([0.3, -0.2, 0.9]), np.array([np.pi, 0, 0]), np.pi * DIAGONAL, np.array([0, 2 * np.pi, 0])),
]


@pytest.mark.parametrize("vector", SPECIAL_VECTORS, ids=str)
def test_matrices_and_derivatives(vector):
    rotation, derivative = matrices_and_derivatives(vector[None])
    np.testing.assert_allclose(rotation[0], Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)
    step = 1e-6
    for axis in range(3):
        either = [
            Rotation.from_rotvec(vector + side * step * np.eye(3)[axis]).as_matrix() for side in (1, -1)
        ]
        numeric = (either[0] - either[1]) / (2 * step)
        np.testing.assert_allclose(derivative[0, :, :, axis], numeric, atol=1e-9)
