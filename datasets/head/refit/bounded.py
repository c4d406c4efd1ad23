"""Least squares with bounds, from normal equations."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dposv

from ....bench.contracts import FloatArray

_ITERATIONS = 100


def solve_bounded(gram: FloatArray, right: FloatArray, bound: FloatArray) -> FloatArray:
    """Minimise x' G x / 2 - r' x over |x_i| <= b_i.

    Projected Newton steps (Bertsekas, "Projected Newton methods for optimization problems with simple
    constraints", SIAM J. Control Optim. 20, 1982): components held at their bound by the gradient are fixed, the
    others take a Newton step, cut back until it descends. Without active bounds that is one Cholesky solution.

    Parameters
    ----------
    gram : (n, n) symmetric positive definite; only the lower triangle is read.
    right : (n,).
    bound : (n,) positive.

    Raises
    ------
    ValueError
        Where ``gram`` is not positive definite.
    """
    x = _solve(gram, right)
    if (np.abs(x) <= bound).all():
        return x
    whole = np.tril(gram) + np.tril(gram, -1).T
    x = np.clip(x, -bound, bound)
    for _ in range(_ITERATIONS):
        gradient = whole @ x - right
        held = (np.abs(x) >= bound) & (gradient * x < 0)
        free = np.flatnonzero(~held)
        step = np.zeros_like(x)
        if len(free):
            step[free] = _solve(whole[np.ix_(free, free)], -gradient[free])
        scale = 1.0
        while scale > 1e-10:
            moved = np.clip(x + scale * step, -bound, bound)
            change = moved - x
            if gradient @ change + 0.5 * change @ whole @ change <= 1e-4 * gradient @ change:
                break
            scale *= 0.5
        else:
            return x
        done = np.abs(change).max(initial=0.0) <= 1e-12 * (1 + np.abs(x).max())
        x = moved
        if done:
            return x
    return x


def _solve(gram: FloatArray, right: FloatArray) -> FloatArray:
    _, solution, failed = dposv(gram, right, lower=1)
    if failed:
        raise ValueError("the normal equations are not positive definite")
    return np.asarray(solution)
