"""The rigid motion between two sets of points."""

from __future__ import annotations

import numpy as np

from ...bench.contracts import FloatArray


def rigid_alignment(points: FloatArray, wanted: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """(4, 4) rigid motion that takes points (n, 3) nearest to ``wanted``, by weighted squared distance.

    Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Cryst. A32, 1976; with the
    sign that excludes reflections. Without weights all points count the same.
    """
    weights = np.ones(len(points)) if weights is None else weights
    share = (weights / weights.sum())[:, None]
    middle, wanted_middle = (share * points).sum(axis=0), (share * wanted).sum(axis=0)
    u, _, vt = np.linalg.svd((share * (points - middle)).T @ (wanted - wanted_middle))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    motion = np.eye(4)
    motion[:3, :3] = (u @ sign @ vt).T
    motion[:3, 3] = wanted_middle - motion[:3, :3] @ middle
    return motion
