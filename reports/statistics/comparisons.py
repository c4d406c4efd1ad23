"""Differences of two methods by subject, the interval of their mean, and the exact sign-flip test on few subjects.

If two methods do not differ, a subject's difference is as likely to be positive as negative. All 2^n
assignments of signs are then equally likely, and the p-value is the share of them whose mean is at least as
far from zero as the one observed: exact for any distribution symmetric about zero, at any number of subjects
(Fisher's randomisation test for pairs).
R. A. Fisher, The Design of Experiments (1935), section 21.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.progress import counted
from ...bench.rows import FRAME, Rows
from ..aggregate import subject_means, summarise, whole_images

if TYPE_CHECKING:
    import pandas as pd

LEVEL = 0.05
LEAST_SUBJECTS = 3
"""Minimum for an interval; two subjects have only one degree of freedom."""
EXACT_UP_TO = 20
"""Maximum number of subjects for which all assignments are tried."""
DRAWS = 99_999
"""Number of random assignments for more subjects; the observed one is added, so that the test keeps its level."""
CHUNK = 4_096


def sign_flip_p(differences: Sequence[float] | FloatArray, *, greater: bool = False) -> float:
    """P-value of the mean of (n,) differences, one per subject; 1 if n is 0.

    Two-sided, or for the alternative that the mean is ``greater`` than zero.
    """
    values = np.asarray(differences, dtype=np.float64)
    if not values.size:
        return 1.0
    # Sums of the same terms in another order differ by rounding; they are treated as equal.
    observed = values.sum() if greater else abs(values.sum())
    threshold = observed - 1e-9 * np.abs(values).sum()
    if values.size <= EXACT_UP_TO:
        sums = np.zeros(1)
        for value in values[1:]:
            sums = np.concatenate([sums + value, sums - value])
        # In the two-sided test the first sign is fixed: flipping all signs does not change the absolute sum.
        sums = np.concatenate([sums + values[0], sums - values[0]]) if greater else np.abs(sums + values[0])
        return float(np.mean(sums >= threshold))
    generator = np.random.default_rng(0)
    extreme = 0
    for start in range(0, DRAWS, CHUNK):
        signs = generator.integers(0, 2, size=(min(CHUNK, DRAWS - start), values.size)) * 2 - 1
        sums = signs @ values
        extreme += int(np.sum((sums if greater else np.abs(sums)) >= threshold))
    return (1 + extreme) / (1 + DRAWS)


def equivalence_p(differences: Sequence[float] | FloatArray, margin: float) -> float:
    """P-value of two one-sided sign-flip tests against means of -``margin`` and below, and of ``margin`` and above.

    The larger of the two p-values (D. Schuirmann, Journal of Pharmacokinetics and Biopharmaceutics 15, 1987). It is small only
    if the mean of the (n,) differences is within the margin; at least 2^-n.
    """
    values = np.asarray(differences, dtype=np.float64)
    return max(sign_flip_p(margin + values, greater=True), sign_flip_p(margin - values, greater=True))


def least_p(subjects: int) -> float:
    """Return the smallest possible p-value for a number of subjects: all differences have the same sign."""
    if subjects < 1:
        return 1.0
    return 2.0 ** (1 - subjects) if subjects <= EXACT_UP_TO else 1.0 / (1 + DRAWS)


def subjects_needed(level: float, comparisons: int = 1) -> int:
    """Number of subjects required for the smallest of several p-values to reach ``level`` after Holm's correction."""
    return next(n for n in range(1, EXACT_UP_TO + 1) if comparisons * least_p(n) <= level)


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p-values of a family of tests, in their order (S. Holm, Scandinavian Journal of Statistics 6, 1979)."""
    values = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    factors = len(values) - np.arange(len(values))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(values[order] * factors))
    return [float(value) for value in adjusted]


def paired_differences(first: pd.DataFrame, second: pd.DataFrame) -> dict[str, float]:
    """First minus second by subject, averaged over the frames of a sequence, then sequences, then seeds.

    Rows are of two methods, of one metric of one task: one for each frame and seed, or for each subject and seed. Raises
    `InputError` unless both methods have finite values of exactly the same frames for every seed.
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


def paired_power(effect: float, subjects: int, level: float = LEVEL) -> float:
    """Power of the two-sided paired t-test for a mean difference of ``effect`` standard deviations (Cohen's d_z) over subjects.

    ``level`` divided by the number of tests is that of the first step of Holm's procedure: a lower bound of the power of each.
    """
    from scipy.special import ncfdtr
    from scipy.stats import f as fisher

    # The square of the test's t has a noncentral F distribution.
    freedom = subjects - 1
    return 1.0 - float(ncfdtr(1, freedom, subjects * effect**2, fisher.ppf(1 - level, 1, freedom)))


def detectable(subjects: int, level: float = LEVEL, power: float = 0.8) -> float:
    """Smallest effect, in standard deviations over subjects, that `paired_power` finds with a power."""
    from scipy.optimize import brentq

    return float(brentq(lambda effect: paired_power(effect, subjects, level) - power, 0.0, 20.0))


def half_width(values: Sequence[float], level: float = LEVEL) -> float:
    """Half the width of the interval of the mean of at least two numbers by Student's t, with confidence 1 - ``level``.

    The standard deviation of subject means includes the variation within subjects (frames, sequences, seeds).
    """
    from scipy.stats import t as student_t  # takes a second to import, which most tables do without

    count = len(values)
    return float(student_t.ppf(1 - level / 2, count - 1)) * stdev(values) / math.sqrt(count)


def interval(values: Sequence[float], level: float = LEVEL) -> tuple[float, float] | None:
    """Interval of the mean of subjects' values over the population of subjects; None with fewer than `LEAST_SUBJECTS`."""
    if len(values) < LEAST_SUBJECTS:
        return None
    half = half_width(values, level)
    return fmean(values) - half, fmean(values) + half


@dataclass(frozen=True)
class PairedComparison:
    """First method minus second on one metric of one task, with subjects as units.

    If ``minus`` names another task, the difference in that task is subtracted: an interaction of methods and tasks, 0 if
    the methods differ equally in both. ``difference`` is None if a method lacks values (``reason``); the interval over the
    population of subjects (``low``, ``high``) is None if there are too few of them.
    """

    task: str
    metric: str
    higher_is_better: bool
    first: str
    second: str
    level: float = LEVEL  # of the test; one minus the confidence of the interval
    differences: tuple[tuple[str, float], ...] = ()  # by subject, means over frames, sequences and seeds
    seeds: tuple[int, int] = (0, 0)  # number of seeds of each method
    difference: float | None = None  # mean over subjects, in the metric's unit
    low: float | None = None
    high: float | None = None
    effect: float | None = None  # Cohen's d_z: mean over standard deviation; None where that is 0
    p: float | None = None  # of the exact sign-flip test, uncorrected
    p_holm: float | None = None  # corrected for the family
    family: int = 0  # comparisons of this metric
    reason: str = ""
    minus: str = ""
    margin: float | None = None  # of the test of equivalence, in the metric's unit; None without this test
    p_equivalence: float | None = None  # of `equivalence_p`, uncorrected
    p_equivalence_holm: float | None = None  # corrected for the family

    @property
    def equivalent(self) -> bool | None:
        """Whether equivalence within the margin is significant; None without a test of equivalence."""
        return None if self.p_equivalence_holm is None else self.p_equivalence_holm <= self.level

    @property
    def subjects(self) -> int:
        """Number of subjects."""
        return len(self.differences)

    @property
    def wins(self) -> int:
        """Number of subjects on which the first method is better."""
        sign = 1 if self.higher_is_better else -1
        return sum(sign * value > 0 for _, value in self.differences)

    def text(self, digits: int) -> str:
        """The difference, and its interval in brackets if there is one; "–" without a difference."""
        if self.difference is None:
            return "–"
        text = f"{self.difference:+.{digits}f}"
        if self.low is None or self.high is None:
            return text
        return f"{text} ({self.low:+.{digits}f}, {self.high:+.{digits}f})"

    @property
    def testable(self) -> bool:
        """Whether the corrected p-value can reach the level with this number of subjects."""
        return self.family * least_p(self.subjects) <= self.level

    @property
    def verdict(self) -> str:
        """Conclusion in words."""
        if self.difference is None or self.p_holm is None:
            return "no comparison"
        if not self.testable:
            needed = subjects_needed(self.level, self.family)
            return f"not testable with {counted(self.subjects, 'subject')} (it takes {needed})"
        if self.p_holm > self.level:
            return "no significant difference"
        if self.minus:
            return "depends on the task"
        return f"{self.first if (self.difference > 0) == self.higher_is_better else self.second} is better"


def compare(
    rows: Rows,
    pairs: Sequence[tuple[str, str]],
    *,
    task: str,
    metric: str,
    higher_is_better: bool,
    level: float = LEVEL,
    minus: str = "",
    margin: float | None = None,
) -> list[PairedComparison]:
    """Compare pairs of methods on one metric of one task ("" for a metric of the avatar as a whole), on whole images.

    The pairs are one family, whose p-values are corrected together by Holm's method. A pair in which a method lacks values
    of frames has a reason instead of a comparison, and is not part of the family. Differences in the task ``minus`` are
    subtracted per subject. With a ``margin``, in the metric's unit, equivalence is tested as well. ``rows`` are
    checked by `Rows.check`. Raises `InputError` if both methods are complete, but on different frames.
    """
    comparisons = []
    tasks = [task, *([minus] if minus else [])]
    summaries = {name: [summarise(rows, name, metric, place) for place in tasks] for name in {*chain(*pairs)}}
    for names in pairs:
        comparison = PairedComparison(
            task, metric, higher_is_better, *names, level, minus=minus, margin=margin
        )
        reasons = [f"{name}: {s.reason}" for name in names for s in summaries[name] if s.value is None]
        if reasons:
            comparisons.append(replace(comparison, reason=" ".join(dict.fromkeys(reasons))))
            continue
        by_subject, *subtracted = (
            paired_differences(*(whole_images(rows, name, metric, place) for name in names))
            for place in tasks
        )
        for other in subtracted:
            if [*by_subject] != [*other]:
                expected = f"the same in both tasks: {', '.join(by_subject)}"
                raise InputError("rows", "subjects", expected, ", ".join(other) or "none")
            by_subject = {subject: value - other[subject] for subject, value in by_subject.items()}
        values = np.array([*by_subject.values()])
        low, high = interval(values.tolist(), level) or (None, None)
        deviation = float(values.std(ddof=1)) if len(values) > 1 else 0.0
        comparisons.append(
            replace(
                comparison,
                differences=tuple(by_subject.items()),
                seeds=(len(rows.seeds(names[0])), len(rows.seeds(names[1]))),
                difference=float(values.mean()),
                low=low,
                high=high,
                effect=float(values.mean()) / deviation if deviation > 0 else None,
                p=sign_flip_p(values),
                p_equivalence=None if margin is None else equivalence_p(values, margin),
            )
        )
    return as_one_family(comparisons)


def as_one_family(comparisons: Iterable[PairedComparison]) -> list[PairedComparison]:
    """Apply Holm's correction to all p-values: differences are one family, equivalences another."""
    members = list(comparisons)
    tested = [c.p for c in members if c.p is not None]
    differences = iter(holm(tested))
    equivalences = iter(holm([c.p_equivalence for c in members if c.p_equivalence is not None]))
    return [
        replace(
            c,
            p_holm=None if c.p is None else next(differences),
            p_equivalence_holm=None if c.p_equivalence is None else next(equivalences),
            family=0 if c.p is None else len(tested),
        )
        for c in members
    ]


@dataclass(frozen=True)
class BestSet:
    """``methods`` that no other is significantly better than; None if ``subjects`` are fewer than ``needed``."""

    methods: frozenset[str] | None
    subjects: int
    needed: int


def best_set(means: Mapping[str, Mapping[str, float]], *, higher_is_better: bool) -> BestSet:
    """Find every method that does not differ significantly from the best.

    Each method is compared with all others by the sign-flip test, with Holm's correction over these comparisons; it is
    excluded if one of them is better. The truly best method is therefore excluded with a probability of at most
    `LEVEL`: a confidence set of the best (J. Hsu, Multiple Comparisons, 1996, chapter 4).
    ``means`` maps each method (at least one) to its mean of each subject; the same subjects for all.
    """
    subjects = sorted(next(iter(means.values())))
    rivals = len(means) - 1
    needed = subjects_needed(LEVEL, rivals)
    if rivals * least_p(len(subjects)) > LEVEL:
        return BestSet(None, len(subjects), needed)
    sign = 1 if higher_is_better else -1
    values = {name: sign * np.array([of[subject] for subject in subjects]) for name, of in means.items()}
    best = []
    for method, scores in values.items():
        leads = [other - scores for name, other in values.items() if name != method]
        adjusted = holm([sign_flip_p(lead) for lead in leads])
        if not any(p <= LEVEL and lead.mean() > 0 for p, lead in zip(adjusted, leads)):
            best.append(method)
    return BestSet(frozenset(best), len(subjects), needed)
