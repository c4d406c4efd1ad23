"""Novelty of test expressions relative to those of training."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..bench.contracts import FloatArray

SPAN_VARIANCE = 0.99
"""Fraction of the training variance in the span of training; the rest is regarded as tracking noise."""


class Novelty(NamedTuple):
    """Novelty of some expressions relative to those of training.

    Attributes
    ----------
    outside : float
        Fraction in [0, 1] of the root mean square displacement that lies outside the span of
        training.
    beyond : float
        Fraction in [0, 1] of the expressions that leave the range of training along some direction of
        its span by more than a tenth of that range.
    """

    outside: float
    beyond: float


def displacement_metric(basis: FloatArray) -> FloatArray:
    """(E, E) matrix from coefficients to faces whose distances are root mean squares over the vertices.

    This is exact without V x T values in memory: distances between faces are distances between coefficients in the
    metric of the basis, (V, 3, E), which is its Gram matrix divided by the number of vertices.
    """
    basis = np.asarray(basis, np.float64)
    values, vectors = np.linalg.eigh(np.einsum("vie,vif->ef", basis, basis) / len(basis))
    metric: FloatArray = vectors * np.sqrt(np.maximum(values, 0))
    return metric


def novelty(train: FloatArray, test: FloatArray, span: float = SPAN_VARIANCE) -> Novelty:
    """Compare faces, (T, E) and (N, E) as `displacement_metric` gives them; at least one of each.

    ``span`` is the fraction of the training variance in the span of training.
    """
    mean = train.mean(axis=0)
    _, singular, axes = np.linalg.svd(train - mean, full_matrices=False)
    variance = singular**2
    if not variance.sum() > 0:
        moved = float(np.any(np.abs(test - mean) > 0))
        return Novelty(moved, moved)
    kept = int(np.searchsorted(np.cumsum(variance) / variance.sum(), span) + 1)
    axes = axes[:kept]
    found, known = (test - mean) @ axes.T, (train - mean) @ axes.T
    total = ((test - mean) ** 2).sum()
    rest = ((test - mean - found @ axes) ** 2).sum()
    low, high = known.min(axis=0), known.max(axis=0)
    margin = 0.1 * (high - low)
    beyond = ((found < low - margin) | (found > high + margin)).any(axis=1)
    return Novelty(float(np.sqrt(rest / total)) if total > 0 else 0.0, float(beyond.mean()))
