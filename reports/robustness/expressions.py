"""Expressions beyond those of training: steps along the principal components of its coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...bench.contracts import Clip, FloatArray, HeadPose

NO_VARIATION = 1e-9
"""A component whose deviation is below this share of the largest one is rounding, not expression."""


@dataclass(frozen=True, eq=False)
class ExpressionComponents:
    """Principal components of expression coefficients.

    Attributes
    ----------
    mean : (E,).
    directions : (D, E) unit vectors, by falling deviation; D is less than asked for where training holds less.
    deviations : (D,) standard deviation along each, all positive.
    """

    mean: FloatArray
    directions: FloatArray
    deviations: FloatArray

    @classmethod
    def of(cls, coefficients: FloatArray, dimensions: int) -> ExpressionComponents:
        """Components of (T, E) coefficients, one row a timestep."""
        mean = coefficients.mean(axis=0)
        _, singular, directions = np.linalg.svd(coefficients - mean, full_matrices=False)
        deviations = singular / np.sqrt(max(len(coefficients) - 1, 1))
        scale = max(float(np.abs(coefficients).max(initial=0.0)), 1.0)
        kept = np.flatnonzero(deviations > NO_VARIATION * scale)[:dimensions]
        return cls(mean, directions[kept], deviations[kept])

    def at(self, component: int, sigmas: float) -> FloatArray:
        """(E,) coefficients so many standard deviations along a component, counted from 0."""
        return np.asarray(self.mean + sigmas * self.deviations[component] * self.directions[component])


@dataclass(frozen=True, eq=False)
class Extreme:
    """A pose to try: ``component`` counts from 1, 0 for the mean expression, and ``sigmas`` says how far along it."""

    component: int
    sigmas: float
    pose: HeadPose

    @property
    def name(self) -> str:
        """Such as ``pc3+2``; ``mean`` for the mean expression."""
        return f"pc{self.component}{self.sigmas:+g}" if self.component else "mean"


def training_poses(clip: Clip) -> list[HeadPose]:
    """Tracked poses of the training timesteps, in order."""
    return [clip.poses[t] for t in sorted({key.timestep for key in clip.splits["train"]})]


def typical_pose(poses: Sequence[HeadPose]) -> HeadPose:
    """The pose whose expression is nearest to the mean expression: a real one, so that all its parts fit together."""
    expressions = np.array([pose.expression for pose in poses], np.float64)
    return poses[int(np.argmin(np.linalg.norm(expressions - expressions.mean(axis=0), axis=1)))]


def extremes(clip: Clip, dimensions: int, sigmas: Sequence[float]) -> list[Extreme]:
    """The mean expression, then every step along every component; the rest of the pose stays the typical one's.

    Taken from training timesteps alone. Poses belong to no timestep, so that no avatar answers with tracking it
    refined for one.
    """
    poses = training_poses(clip)
    base = replace(typical_pose(poses), timestep=None)
    dtype = base.expression.dtype
    components = ExpressionComponents.of(np.array([p.expression for p in poses], np.float64), dimensions)

    def posed(expression: FloatArray) -> HeadPose:
        return replace(base, expression=expression.astype(dtype))

    found = [Extreme(0, 0.0, posed(components.mean))]
    for index in range(len(components.deviations)):
        found += [Extreme(index + 1, float(s), posed(components.at(index, s))) for s in sigmas if s]
    return found
