"""Paired comparisons of methods on one metric, and what they allow one to say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...bench.rows import ALL, Rows
from ..aggregate import summarise
from .bootstrap import interval
from .holm import holm
from .pairs import SubjectPairs, pair
from .sign_flip import least_p, sign_flip_p, subjects_needed

LEVEL = 0.05


@dataclass(frozen=True)
class Comparison:
    """First method minus second on one metric of one task; the subject is the unit.

    Attributes
    ----------
    differences : by subject, means over frames, sequences and seeds.
    seeds : how many of each method.
    difference : their mean over subjects, in the metric's unit; None where a method lacks values (``reason``).
    low, high : confidence interval of that mean over the population of subjects; None with too few of them.
    effect : mean over the standard deviation of the subjects' differences (Cohen's d_z); None where that is 0.
    p, p_holm : of the exact sign-flip test, alone and corrected for the ``family`` of comparisons of this metric.
    level : of the test; one minus the confidence of the interval.
    """

    task: str
    metric: str
    higher_is_better: bool
    first: str
    second: str
    level: float = LEVEL
    differences: tuple[tuple[str, float], ...] = ()
    seeds: tuple[int, int] = (0, 0)
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    effect: float | None = None
    p: float | None = None
    p_holm: float | None = None
    family: int = 0
    reason: str = ""

    @property
    def subjects(self) -> int:
        """How many there are."""
        return len(self.differences)

    @property
    def wins(self) -> int:
        """Subjects on which the first method is better."""
        sign = 1 if self.higher_is_better else -1
        return sum(sign * value > 0 for _, value in self.differences)

    @property
    def testable(self) -> bool:
        """Whether so many subjects could give a corrected p-value at the level at all."""
        return bool(self.family) and self.family * least_p(self.subjects) <= self.level

    @property
    def verdict(self) -> str:
        """What may be said, in words."""
        if self.difference is None or self.p_holm is None:
            return "no comparison"
        if not self.testable:
            unit = "subject" if self.subjects == 1 else "subjects"
            needed = subjects_needed(self.level, self.family)
            return f"not testable with {self.subjects} {unit} (it takes {needed})"
        if self.p_holm > self.level:
            return "cannot be told apart"
        return f"{self.first if (self.difference > 0) == self.higher_is_better else self.second} is better"


def compare(
    rows: Rows,
    pairs: Sequence[tuple[str, str]],
    *,
    task: str,
    metric: str,
    region: str,
    higher_is_better: bool,
    level: float = LEVEL,
) -> list[Comparison]:
    """Compare pairs of methods on one metric of one task ("" for a metric of the avatar as a whole).

    The pairs are one family: their p-values are corrected together, by Holm. A method that lacks a value of any
    frame has no comparison, and the reason stands in its place; it does not count in the family.

    Parameters
    ----------
    rows : checked by `Rows.check`.

    Raises
    ------
    InputError : both methods are complete, yet not on the same frames.
    """
    found = []
    for first, second in pairs:
        comparison = Comparison(task, metric, higher_is_better, first, second, level)
        summaries = [
            summarise(rows, method=method, metric=metric, task=task, region=region)
            for method in (first, second)
        ]
        absent = [f"{m}: {s.reason}" for m, s in zip((first, second), summaries) if s.value is None]
        if absent:
            found.append(replace(comparison, reason=" ".join(absent)))
            continue
        values = [
            rows.select(method=method, metric=metric, task=task, region=region, seeds=ALL)
            for method in (first, second)
        ]
        seeds = (len(rows.seeds(first)), len(rows.seeds(second)))
        found.append(_compared(replace(comparison, seeds=seeds), pair(*values)))
    return corrected(found)


def corrected(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Correct the p-values of comparisons that belong to one family."""
    tested = [c for c in comparisons if c.p is not None]
    adjusted = iter(holm([c.p for c in tested if c.p is not None]))
    return [c if c.p is None else replace(c, p_holm=next(adjusted), family=len(tested)) for c in comparisons]


def _compared(comparison: Comparison, subjects: Sequence[SubjectPairs]) -> Comparison:
    """Fill in what the pairs of a comparison say."""
    values = np.array([subject.difference for subject in subjects])
    bounds = interval(subjects, comparison.level)
    deviation = float(values.std(ddof=1)) if len(values) > 1 else 0.0
    return replace(
        comparison,
        differences=tuple((s.subject, float(v)) for s, v in zip(subjects, values)),
        difference=float(values.mean()),
        low=None if bounds is None else bounds[0],
        high=None if bounds is None else bounds[1],
        effect=float(values.mean()) / deviation if deviation > 0 else None,
        p=sign_flip_p(values),
    )


@dataclass(frozen=True)
class BestSet:
    """The methods that may be the best.

    Attributes
    ----------
    methods : those that no other one is told to be better than; None where so few subjects can tell nothing.
    subjects : how many there are.
    needed : subjects that it takes for this many methods.
    """

    methods: frozenset[str] | None
    subjects: int
    needed: int


def best_set(
    means: Mapping[str, Mapping[str, float]], *, higher_is_better: bool, level: float = LEVEL
) -> BestSet:
    """Find every method that cannot be told from the best.

    Each method is compared with all others by the sign-flip test, Holm over these comparisons; it is left out if
    one of them is better. Whichever method is truly the best is therefore left out with a probability of at most
    ``level``, however it was chosen: a confidence set of the best (J. Hsu, Multiple Comparisons, 1996, chapter 4).

    Parameters
    ----------
    means : by method (at least two), its mean of each subject (means over frames, sequences and seeds); the same
        subjects for all.
    """
    methods = list(means)
    subjects = sorted(means[methods[0]])
    values = np.array([[means[method][subject] for subject in subjects] for method in methods])
    values = values if higher_is_better else -values
    count, rivals = len(subjects), len(methods) - 1
    needed = subjects_needed(level, rivals)
    if rivals * least_p(count) > level:
        return BestSet(None, count, needed)
    kept = []
    for index, method in enumerate(methods):
        others = np.delete(values, index, axis=0) - values[index]
        adjusted = holm([sign_flip_p(difference) for difference in others])
        if not any(p <= level and difference.mean() > 0 for p, difference in zip(adjusted, others)):
            kept.append(method)
    return BestSet(frozenset(kept), count, needed)
