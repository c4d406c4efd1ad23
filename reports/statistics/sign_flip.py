"""The exact sign-flip test on paired differences of few subjects (Fisher's randomisation test for pairs).

Where two methods do not differ, a subject's difference is as likely to be positive as negative. All 2^n assignments
of signs are then equally likely, and the p-value is the share of them whose mean is at least as far from zero as
the one observed: exact for any distribution symmetric about zero, at any number of subjects. R. A. Fisher, The
Design of Experiments (1935), section 21.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...bench.contracts import FloatArray

EXACT_UP_TO = 20
"""Subjects up to which every assignment is tried."""
DRAWS = 99_999
"""Random assignments beyond; the observed one counts as a further one, so that the test keeps its level."""
CHUNK = 4_096


def sign_flip_p(differences: Sequence[float] | FloatArray) -> float:
    """Two-sided p-value of the mean of (n,) differences, one per subject; 1 where there are none."""
    values = np.asarray(differences, dtype=np.float64)
    if not np.isfinite(values).all():
        raise ValueError("differences must be finite")
    if not values.size:
        return 1.0
    # Sums of the same terms in another order differ by rounding; they count as equal.
    threshold = abs(values.sum()) - 1e-9 * np.abs(values).sum()
    if values.size <= EXACT_UP_TO:
        # The first sign can stay: turning all signs leaves the absolute sum as it is.
        sums = values[:1]
        for value in values[1:]:
            sums = np.concatenate([sums + value, sums - value])
        return float(np.mean(np.abs(sums) >= threshold))
    generator = np.random.default_rng(0)
    extreme = 0
    for start in range(0, DRAWS, CHUNK):
        signs = generator.integers(0, 2, size=(min(CHUNK, DRAWS - start), values.size)) * 2 - 1
        extreme += int(np.sum(np.abs(signs @ values) >= threshold))
    return (1 + extreme) / (1 + DRAWS)


def least_p(subjects: int) -> float:
    """Return the least p-value that so many subjects can give: that of differences which all have one sign."""
    if subjects < 1:
        return 1.0
    return 2.0 ** (1 - subjects) if subjects <= EXACT_UP_TO else 1.0 / (1 + DRAWS)


def subjects_needed(level: float, comparisons: int = 1) -> int:
    """Return how many subjects it takes for the first of so many comparisons to reach ``level`` after Holm."""
    return next(n for n in range(1, EXACT_UP_TO + 1) if comparisons * least_p(n) <= level)
