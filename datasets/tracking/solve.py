"""Gauss-Newton steps for the poses of all timesteps and one shape: normal equations with an arrowhead matrix."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...bench.contracts import FloatArray
from .rig import PosedPoints


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


class NormalEquations:
    """Sums of ``J' A J`` and ``J' b`` over points, for T timesteps with D parameters each and S shared ones."""

    def __init__(self, timesteps: int, pose_size: int, shape_size: int):
        whole = pose_size + shape_size
        self._split = pose_size
        self._matrices = np.zeros((timesteps, whole, whole))
        self._rights = np.zeros((timesteps, whole))

    def add(self, timestep: int, posed: PosedPoints, curvature: FloatArray, slope: FloatArray) -> None:
        """Add the points of a timestep.

        Parameters
        ----------
        posed : PosedPoints
            P points and their derivatives.
        curvature : FloatArray
            (P, 3, 3) second derivatives of the cost by the points, without those of the residuals.
        slope : FloatArray
            (P, 3) negative first derivatives of the cost by the points.
        """
        jacobian = np.concatenate([posed.by_pose, posed.by_shape], axis=2)
        bent = np.einsum("pij,pjk->pik", curvature.astype(jacobian.dtype), jacobian)
        width = jacobian.shape[2]
        flat = jacobian.reshape(-1, width)
        self._matrices[timestep] += flat.T @ bent.reshape(-1, width)
        self._rights[timestep] += flat.T @ slope.astype(jacobian.dtype).reshape(-1)

    def step(self, state: HeadState, prior: HeadPrior, damping: float = 1e-6) -> HeadState:
        """The state after a step with the prior.

        Parameters
        ----------
        damping : float
            Fraction of the diagonal that is added to it (Levenberg-Marquardt).
        """
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
        own, shared, corner = (
            matrices[:, :split, :split],
            matrices[:, :split, split:],
            matrices[:, split:, split:],
        )
        solved = np.linalg.solve(own, np.concatenate([rights[:, :split, None], shared], axis=2))
        schur = corner.sum(axis=0) - np.einsum("tds,tdr->sr", shared, solved[:, :, 1:])
        right = rights[:, split:].sum(axis=0) - np.einsum("tds,td->s", shared, solved[:, :, 0])
        change = np.linalg.solve(schur, right) if len(right) else right
        return HeadState(state.shape + change, state.poses + solved[:, :, 0] - solved[:, :, 1:] @ change)
