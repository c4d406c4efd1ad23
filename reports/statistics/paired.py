"""Differences of two methods by subject, and the interval of their mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean, stdev
from typing import Any

import pandas as pd
from scipy.stats import t as student_t

from ...bench.errors import InputError
from ...bench.rows import FRAME
from ..aggregate import subject_means

LEVEL = 0.05
LEAST_SUBJECTS = 3
"""Minimum for an interval; two subjects have only one degree of freedom."""


def paired_differences(first: pd.DataFrame, second: pd.DataFrame) -> dict[str, float]:
    """First minus second by subject, averaged over the frames of a sequence, then sequences, then seeds.

    Parameters
    ----------
    first, second : pandas.DataFrame
        Rows of two methods, of one metric of one task: one for each frame and seed, or for each subject and seed.

    Raises
    ------
    InputError
        The methods do not have finite values of exactly the same frames for every seed.
    """
    frames = [_frames(rows) for rows in (first, second)]
    unmatched = frames[0].symmetric_difference(frames[1])
    if len(unmatched):
        where = " ".join(map(str, unmatched[0]))
        raise InputError("rows", where, "a value of both methods", f"{len(unmatched)} frames with one alone")
    ours, theirs = subject_means(first), subject_means(second)
    return {subject: value - theirs[subject] for subject, value in ours.items()}


def _frames(rows: pd.DataFrame) -> pd.Index[Any]:
    """Frames of the rows, with exactly one finite value for every seed."""
    values = rows.set_index([*FRAME, "seed"])["value"].astype(float)
    if values.index.has_duplicates:
        twice = values.index[values.index.duplicated()][0]
        raise InputError("rows", " ".join(map(str, twice)), "one value of each frame and seed", "several")
    table = values.unstack("seed")
    if table.isna().to_numpy().any():
        frame = table.index[table.isna().any(axis=1)][0]
        raise InputError("rows", " ".join(map(str, frame)), "a finite value in every seed", "none in some")
    return table.index


def half_width(values: Sequence[float], level: float = LEVEL) -> float:
    """Half the width of the interval of the mean of at least two numbers by Student's t, with confidence 1 - ``level``.

    The standard deviation of subject means includes the variation within subjects (frames, sequences, seeds).
    """
    count = len(values)
    return float(student_t.ppf(1 - level / 2, count - 1)) * stdev(values) / math.sqrt(count)


def interval(values: Sequence[float], level: float = LEVEL) -> tuple[float, float] | None:
    """Interval of the mean of subjects' values over the population of subjects; None with fewer than `LEAST_SUBJECTS`."""
    if len(values) < LEAST_SUBJECTS:
        return None
    half = half_width(values, level)
    return fmean(values) - half, fmean(values) + half
