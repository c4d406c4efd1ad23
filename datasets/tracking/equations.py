"""Gauss-Newton steps for the poses of all timesteps and one shape: normal equations with an arrowhead matrix, or without
shape a chain of timesteps."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded

from ...bench.contracts import FloatArray
from .rig import PosedPoints

SPEED = ((1.5,) * 6 + (3.0, 1.0, 1.0) + (np.inf,) * 6, 0.3, 15.0)
"""Usual speeds: of angles, radians, the translation, metres, and coefficients, each in a second. Eyes jump."""


class HeadState(NamedTuple):
    """Estimate of a tracker."""

    shape: FloatArray
    """(S,) identity coefficients."""
    poses: FloatArray
    """(T, D) columns of `PoseColumns`."""


class HeadPrior(NamedTuple):
    """Expected magnitudes of the parameters; infinity disables the prior, 0 fixes the parameter."""

    pose: FloatArray
    """(D,) standard deviations around 0."""
    shape: FloatArray
    """(S,) the same."""


class MotionPrior(NamedTuple):
    """Expected differences between the poses of consecutive timesteps."""

    before: FloatArray
    """(D,) pose before the first one, which is kept."""
    deviations: FloatArray
    """(T, D) standard deviations of the differences from the pose before; infinity for none."""

    @classmethod
    def of(cls, before: FloatArray, seconds: FloatArray) -> MotionPrior:
        """The prior by `SPEED`. ``seconds``: (T,) since the timestep before."""
        angles, translation, coefficient = SPEED
        count = len(before) - len(angles) - 3
        usual = np.array([*angles, *(translation,) * 3, *(coefficient,) * count])
        return cls(before, seconds[:, None] * usual)


class NormalEquations:
    """Sums of ``J' A J`` and ``J' b`` over points, for T timesteps with D parameters each and S shared ones.

    ``state``: Estimate with these sizes.
    """

    def __init__(self, state: HeadState):
        timesteps, self._split = state.poses.shape
        whole = self._split + len(state.shape)
        self._matrices = np.zeros((timesteps, whole, whole))
        self._rights = np.zeros((timesteps, whole))
        self._links: FloatArray | None = None

    def add(self, timestep: int, posed: PosedPoints, curvature: FloatArray, slope: FloatArray) -> None:
        """Add the points of a timestep.

        ``posed``: P points and their derivatives. ``curvature``: (P, 3, 3) second derivatives of the cost by the points,
        without those of the residuals. ``slope``: (P, 3) negative first derivatives of the cost by the points.
        """
        jacobian = np.concatenate([posed.by_pose, posed.by_shape], axis=2)
        bent = np.einsum("pij,pjk->pik", curvature.astype(jacobian.dtype), jacobian)
        width = jacobian.shape[2]
        flat = jacobian.reshape(-1, width)
        self._matrices[timestep] += flat.T @ bent.reshape(-1, width)
        self._rights[timestep] += flat.T @ slope.astype(jacobian.dtype).reshape(-1)

    def add_residuals(
        self, timestep: int, jacobian: FloatArray, weight: FloatArray, residual: FloatArray
    ) -> None:
        """Add residuals (n,) of a timestep with weights (n,) and derivatives (n, D + S) of the estimated values."""
        weighted = jacobian * weight[:, None]
        self._matrices[timestep] += jacobian.T @ weighted
        self._rights[timestep] += weighted.T @ residual

    def link(self, poses: FloatArray, motion: MotionPrior) -> None:
        """Expect each of the poses (T, D) to differ little from the one before."""
        stiffness = motion.deviations**-2.0
        pull = stiffness * np.diff(poses, axis=0, prepend=motion.before[None])
        pose = np.arange(self._split)
        self._links = stiffness[1:]
        self._matrices[:, pose, pose] += stiffness
        self._matrices[:-1, pose, pose] += stiffness[1:]
        self._rights[:, pose] -= pull
        self._rights[:-1, pose] += pull[1:]

    def step(self, state: HeadState, prior: HeadPrior, damping: float = 1e-6) -> HeadState:
        """The state after a step with the prior. ``damping``: Fraction of the diagonal that is added to it
        (Levenberg-Marquardt)."""
        split = self._split
        deviations = np.concatenate([prior.pose, prior.shape])
        free = deviations > 0
        with np.errstate(divide="ignore"):
            stiffness = np.where(free, 1 / deviations**2, 0.0)
        count = len(self._matrices)
        values = np.concatenate(
            [state.poses, np.broadcast_to(state.shape, (count, len(state.shape)))], axis=1
        )
        # The shape has one prior, divided among the timesteps.
        stiffness[split:] /= count
        matrices = self._matrices * (free[:, None] & free)
        rights = (self._rights - stiffness * values) * free
        size = len(free)
        diagonal = np.arange(size)
        matrices[:, diagonal, diagonal] += (
            stiffness + damping * matrices[:, diagonal, diagonal] + 1e-9 + ~free
        )
        if self._links is not None:  # there is no shape
            return state._replace(poses=state.poses + _chain(matrices, rights, self._links))
        own, mixed, corner = (
            matrices[:, :split, :split],
            matrices[:, :split, split:],
            matrices[:, split:, split:],
        )
        solved = np.linalg.solve(own, np.concatenate([rights[:, :split, None], mixed], axis=2))
        schur = corner.sum(axis=0) - np.einsum("tds,tdr->sr", mixed, solved[:, :, 1:])
        right = rights[:, split:].sum(axis=0) - np.einsum("tds,td->s", mixed, solved[:, :, 0])
        change = np.linalg.solve(schur, right) if len(right) else right
        return HeadState(state.shape + change, state.poses + solved[:, :, 0] - solved[:, :, 1:] @ change)


def _chain(matrices: FloatArray, rights: FloatArray, links: FloatArray) -> FloatArray:
    """(T, D) solution of systems of which each is linked with the next one. ``matrices``: (T, D, D), symmetric.
    ``links``: (T - 1, D) negative derivatives between the same parameters of consecutive timesteps."""
    count, size = rights.shape
    bands = np.zeros((size + 1, count * size))
    for below in range(size):
        diagonal = np.diagonal(matrices, -below, 1, 2)  # (T, size - below)
        bands[below].reshape(count, size)[:, : size - below] = diagonal
    bands[size, : (count - 1) * size] = -links.ravel()
    return np.asarray(solveh_banded(bands, rights.ravel(), lower=True)).reshape(count, size)


def continuous(poses: FloatArray) -> FloatArray:
    """Poses (T, D) whose rotation vectors (the first three columns) differ least from those of the timestep before. A head that
    faces a camera is turned by about half a turn, where there are two vectors for about the same rotation."""
    result = poses.copy()
    for before, after in pairwise(result):
        angle = max(float(np.linalg.norm(after[:3])), 1e-9)
        other = after[:3] * (1 - 2 * np.pi / angle)
        if np.linalg.norm(other - before[:3]) < np.linalg.norm(after[:3] - before[:3]):
            after[:3] = other
    return result
