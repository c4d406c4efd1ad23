"""Axis-angle rotations in numpy: matrices with their derivatives, and the way back."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ....bench.contracts import FloatArray

_GENERATORS = np.array(
    [
        [[0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ],
    dtype=np.float64,
)
_DERIVATIVE_SERIES_BELOW = 1e-2  # squared angle under which the third coefficient's closed form cancels


def matrices(axis_angles: FloatArray) -> FloatArray:
    """(n, 3, 3) rotation matrices of (n, 3) axis-angle vectors, radians."""
    return np.asarray(Rotation.from_rotvec(axis_angles).as_matrix())


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


def axis_angles(rotations: FloatArray) -> FloatArray:
    """(n, 3) axis-angle vectors of rotation matrices (n, 3, 3), of length at most pi."""
    return np.asarray(Rotation.from_matrix(rotations).as_rotvec())
