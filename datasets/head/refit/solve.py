"""The search for the angles of one timestep."""

from __future__ import annotations

from typing import NamedTuple

import nlopt
import numpy as np

from ....bench.contracts import FloatArray
from .problem import SEARCHED, FitProblem, Frame
from .settings import RefitSettings

_ALGORITHMS = {"slsqp": nlopt.LD_SLSQP, "lbfgs": nlopt.LD_LBFGS, "mma": nlopt.LD_MMA}


class Solution(NamedTuple):
    """A fitted timestep."""

    coefficients: FloatArray
    """(E + L,) expression, then eyelids."""
    angles: FloatArray
    """(9,) jaw, left eye, right eye; axis-angle, radians."""
    value: float
    """Of the objective, mm^2."""
    evaluations: int


def angle_bounds(settings: RefitSettings) -> FloatArray:
    """(9,) largest magnitudes of the angles."""
    return np.repeat([settings.jaw_bound] + [settings.eye_bound] * (len(SEARCHED) - 1), 3)


def solve_frame(
    problem: FitProblem, frame: Frame, start: FloatArray, fixed: FloatArray, settings: RefitSettings
) -> Solution:
    """Fit one timestep.

    Parameters
    ----------
    start : (9,) angles to start from, such as the previous timestep's.
    fixed : (9,) values of the angles that move no vertex with a target, and so are not searched.
    """
    searched, limit = problem.searched, angle_bounds(settings)
    scale = problem.scale[searched]
    best: list[Solution] = []
    count = 0

    def objective(values: FloatArray, gradient: FloatArray) -> float:
        nonlocal count
        count += 1
        angles = np.where(searched, 0.0, fixed)
        angles[searched] = values * scale
        found = problem.evaluate(frame, angles)
        if gradient.size:
            gradient[:] = found.gradient[searched] * scale
        if not best or found.value < best[0].value:
            best[:] = [Solution(found.coefficients, angles, found.value, count)]
        return found.value

    first = np.clip(start, -limit, limit)[searched] / scale
    if not searched.any():
        objective(first, np.zeros(0))
        return best[0]
    search = nlopt.opt(_ALGORITHMS[settings.algorithm], int(searched.sum()))
    search.set_min_objective(objective)
    search.set_lower_bounds(-limit[searched] / scale)
    search.set_upper_bounds(limit[searched] / scale)
    search.set_xtol_abs(settings.tolerance / scale)
    search.set_maxeval(settings.evaluations)
    try:
        search.optimize(first)
    except (nlopt.RoundoffLimited, nlopt.runtime_error):
        pass  # No step descends further, or a line search gave up: the best point so far is the answer.
    return best[0]._replace(evaluations=count)
