"""Timesteps whose fit differs from that of their neighbours."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from ...bench.contracts import BoolArray, FloatArray
from ..head.rotations import rotation_of
from .rig import PoseColumns

WINDOW = 9
"""Timesteps with whose median one in their middle is compared."""
TURN, MOVE = 0.25, 0.08
"""Minimum rotation of the head, radians, and translation, metres, from the median that count as a jump."""
USUAL = 6.0
"""Minimum ratio of a jump to the median difference, for captures with few timesteps or fast motion."""
WORSE = 2.5
"""Minimum ratio of a residual to its median that counts as a fit that failed."""


def outliers(poses: FloatArray, residuals: FloatArray, columns: PoseColumns) -> BoolArray:
    """(T,) timesteps without a fit to landmarks, with a jump of the head, or with a much larger residual than their neighbours.

    Parameters
    ----------
    poses : FloatArray
        (T, D) columns of ``columns``.
    residuals : FloatArray
        (T, 2) `TimestepResidual` without the timestep; 0 pixels where no landmark was used.
    """
    turns = (rotation_of(poses[:, :3]) * rotation_of(poses[:, 3:6])).as_matrix().reshape(-1, 9)
    wrong = (residuals[:, 0] <= 0) | (residuals > WORSE * _median(residuals)).any(axis=1)
    # The Frobenius norm of the difference of two rotations is about their angle times the root of 2.
    for values, least in ((turns / np.sqrt(2), TURN), (poses[:, columns.translation], MOVE)):
        apart = np.linalg.norm(values - _median(values), axis=1)
        wrong |= apart > max(least, USUAL * float(np.median(apart)))
    return np.asarray(wrong)


def _median(values: FloatArray) -> FloatArray:
    return np.asarray(ndimage.median_filter(values, (WINDOW, 1), mode="nearest"))
