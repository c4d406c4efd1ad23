"""Conversions between rotation representations, with finite gradients everywhere.

Every function takes any batch shape. Axis-angle vectors are in radians; quaternions are real part first
(w, x, y, z); matrices act on column vectors. Near the zero rotation, where the textbook formulae divide zero
by zero, the even functions sin(t)/t and (1 - cos t)/t^2 are evaluated as power series in t^2, so that values
and derivatives of any order keep full precision there.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from ...bench.contracts import FloatArray
from ...bench.native.dispatch import to_device

# Below this squared argument the series is used. Five terms leave a truncation error under 3e-15; above it
# the derivative of the direct formula loses at most a factor 1/0.04 of the working precision.
_SERIES_BELOW = 0.04


def _sinc(squared: Tensor) -> Tensor:
    """sin(t)/t as a function of t^2."""
    series = 1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42 * (1 - squared / 72)))
    near = squared < _SERIES_BELOW
    angle = torch.where(near, torch.ones_like(squared), squared).sqrt()
    return torch.where(near, series, torch.sin(angle) / angle)


def _versine(squared: Tensor) -> Tensor:
    """(1 - cos t)/t^2 as a function of t^2; it equals sinc(t/2)^2 / 2, which does not cancel."""
    return 0.5 * _sinc(squared / 4).square()


def skew(vector: Tensor) -> Tensor:
    """Cross-product matrix: ``skew(a) @ b == cross(a, b)``. (..., 3) to (..., 3, 3)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Rotation matrices of axis-angle vectors (Rodrigues' formula). (..., 3) to (..., 3, 3). R = I + sin(t)/t K + (1 -
    cos t)/t^2 K^2 with K = skew(v), t = |v|."""
    squared = axis_angle.square().sum(-1)[..., None, None]
    cross = skew(axis_angle)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + _sinc(squared) * cross + _versine(squared) * (cross @ cross)


def rotation_of(axis_angle: FloatArray) -> Rotation:
    """SciPy's rotation of axis-angle vectors, (3,) or (N, 3). Vectors are copied because SciPy refuses read-only
    float64 arrays, which is what methods receive."""
    return Rotation.from_rotvec(np.array(axis_angle, np.float64))


def axis_angle_to_quaternion(axis_angle: Tensor) -> Tensor:
    """Unit quaternions (w, x, y, z) of axis-angle vectors. (..., 3) to (..., 4)."""
    quarter = axis_angle.square().sum(-1, keepdim=True) / 4
    real = 1 - quarter * _versine(quarter)
    return torch.cat([real, 0.5 * _sinc(quarter) * axis_angle], dim=-1)


def quaternion_to_axis_angle(quaternion: Tensor) -> Tensor:
    """Axis-angle vectors of length at most pi. (..., 4) to (..., 3); the input need not be of unit length. At exactly
    pi both signs of the axis are valid; the one with the given imaginary part is returned."""
    unit = normalize(quaternion, dim=-1)
    unit = torch.where(unit[..., :1] < 0, -unit, unit)
    real, imaginary = unit[..., :1], unit[..., 1:]
    squared = imaginary.square().sum(-1, keepdim=True)
    near = squared < 1e-3
    # 2 atan2(s, w)/s = 2 asin(s)/s for unit quaternions; the series of atan(s/w)/s around s = 0.
    real_near = torch.where(near, real, torch.ones_like(real)).clamp_min(0.5)
    ratio = torch.where(near, squared, torch.zeros_like(squared)) / real_near.square()
    series = 1 - ratio * (1 / 3 - ratio * (1 / 5 - ratio * (1 / 7 - ratio * (1 / 9 - ratio / 11))))
    sine = torch.where(near, torch.ones_like(squared), squared).sqrt()
    factor = torch.where(near, 2 * series / real_near, 2 * torch.atan2(sine, real) / sine)
    return factor * imaginary


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Rotation matrices of quaternions (w, x, y, z) of any non-zero length. (..., 4) to (..., 3, 3)."""
    w, x, y, z = normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


@cache
def _quaternion_products(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """(16, 9) and (16, 1): the entries of 4 q q^T as a linear map of those of a rotation matrix, and the constants added to them."""
    entries = torch.zeros(4, 4, 3, 3, dtype=dtype)
    for axis in range(3):
        following, last = (axis + 1) % 3, (axis + 2) % 3
        for row in range(4):
            entries[row, row, axis, axis] = 1 if row in (0, axis + 1) else -1
        for row, column, sign in ((0, axis + 1, -1), (following + 1, last + 1, 1)):
            for first, second in ((row, column), (column, row)):
                entries[first, second, last, following] = 1
                entries[first, second, following, last] = sign
    return to_device(entries.view(16, 9), device), to_device(torch.eye(4, dtype=dtype).view(16, 1), device)


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Unit quaternions (w, x, y, z), w >= 0, of rotation matrices. (..., 3, 3) to (..., 4).

    A rotation matrix gives all products of the quaternion's components, 4 q q^T, without a root. Its row with
    the largest diagonal has length at least 2, so normalising that row is well conditioned everywhere.
    """
    # Components are rows: sums over the first axis are several times faster on the CPU than those over columns of four.
    linear, constant = _quaternion_products(matrix.dtype, matrix.device)
    products = torch.addmm(constant, linear, matrix.reshape(-1, 9).t()).view(4, 4, -1)
    # The diagonal sums to 4, so its largest entry is at least 1 for any matrix, and there is no division by 0.
    largest = products.diagonal().t().contiguous().max(0).indices
    chosen = products.gather(0, largest.expand(1, 4, -1))[0]
    length = torch.copysign(chosen.square().sum(0).sqrt(), chosen[0])  # with the sign of w
    return (chosen / length).t().contiguous().view(*matrix.shape[:-2], 4)


_GENERATORS = np.array(
    [
        [[0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ],
    dtype=np.float64,
)
_DERIVATIVE_SERIES_BELOW = 1e-2  # squared angle under which the third coefficient's closed form cancels


def matrices_and_derivatives(axis_angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation matrices (n, 3, 3) and their derivatives (n, 3, 3, 3), the last axis being the vector's component.

    With K = skew(v), t = |v|: R = I + a K + b K^2 for a = sin(t)/t, b = (1 - cos t)/t^2, and
    dR/dv_k = R skew(J e_k) with the right Jacobian J = I - b K + c K^2, c = (t - sin t)/t^3.
    """
    squared = np.einsum("ni,ni->n", axis_angles, axis_angles)[:, None, None]
    angle = np.sqrt(squared)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    near = squared < _DERIVATIVE_SERIES_BELOW
    series = 1 / 6 - squared / 120 * (1 - squared / 42 * (1 - squared / 72))
    c = np.where(near, series, (1 - a) / np.where(near, 1.0, squared))
    cross = np.tensordot(axis_angles, _GENERATORS, 1)
    square = cross @ cross
    identity = np.eye(3)
    rotation = identity + a * cross + b * square
    jacobian = identity - b * cross + c * square
    # skew(J e_k) = sum_i J_ik G_i
    return rotation, np.einsum("nrs,isc,nik->nrck", rotation, _GENERATORS, jacobian, optimize=False)
