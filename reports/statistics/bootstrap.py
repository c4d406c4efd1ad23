"""Two methods' values of one metric, matched frame by frame, for comparisons.

The levels are subject -> sequence -> timestep (with its cameras), and, separately, the seeds of each method.
Avatars of different seeds are trained apart, so the seeds of two methods are not paired with each other; the
frames are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.rows import FRAME


@dataclass(frozen=True, eq=False)
class SequencePairs:
    """A sequence of one subject, S1 and S2 seeds, T timesteps in order: (S1, T) and (S2, T) sums over the cameras of
    each timestep, and (T,) how many cameras there are."""

    first: FloatArray
    second: FloatArray
    cameras: FloatArray

    @property
    def centred(self) -> FloatArray:
        """(T,) difference of each timestep, means over seeds and cameras, less the sequence's own mean."""
        per_timestep = (self.first.mean(axis=0) - self.second.mean(axis=0)) / self.cameras
        return per_timestep - per_timestep.mean()

    def means(self) -> tuple[FloatArray, FloatArray]:
        """(S1,) and (S2,) means over the frames of the sequence."""
        frames = self.cameras.sum()
        return self.first.sum(axis=1) / frames, self.second.sum(axis=1) / frames


@dataclass(frozen=True, eq=False)
class SubjectPairs:
    """One subject: the unit of inference."""

    subject: str
    sequences: tuple[SequencePairs, ...]

    def means(self) -> tuple[FloatArray, FloatArray]:
        """(S1,) and (S2,) means over frames, then sequences: each seed of both methods."""
        first, second = zip(*(sequence.means() for sequence in self.sequences))
        return np.mean(first, axis=0), np.mean(second, axis=0)

    @property
    def difference(self) -> float:
        """First minus second, means over frames, sequences and seeds."""
        first, second = self.means()
        return float(first.mean() - second.mean())


def pair(first: pd.DataFrame, second: pd.DataFrame) -> tuple[SubjectPairs, ...]:
    """Match two methods' rows of one metric of one task (one per frame and seed, or per subject and seed).

    Raises `InputError` unless both have values of exactly the same frames, in every seed.
    """
    tables = [_by_seed(rows) for rows in (first, second)]
    unmatched = tables[0].index.symmetric_difference(tables[1].index)
    if len(unmatched):
        where = " ".join(map(str, unmatched[0]))
        raise InputError("rows", where, "a value of both methods", f"{len(unmatched)} frames with one alone")
    joined = pd.concat(tables, axis=1, keys=["first", "second"]).sort_index()
    timesteps = joined.groupby(level=["subject", "sequence", "timestep"], sort=True)
    sums, counts = timesteps.sum(), timesteps.size().to_numpy().astype(np.float64)
    first_sums, second_sums = sums["first"].to_numpy(), sums["second"].to_numpy()
    subjects: dict[str, list[SequencePairs]] = {}
    for own in sums.groupby(level=["subject", "sequence"], sort=True).indices.values():
        sequence = SequencePairs(first_sums[own].T, second_sums[own].T, counts[own])
        subjects.setdefault(str(sums.index[own[0]][0]), []).append(sequence)
    return tuple(SubjectPairs(subject, tuple(sequences)) for subject, sequences in subjects.items())


def _by_seed(rows: pd.DataFrame) -> pd.DataFrame:
    """Values by frame (rows) and seed (columns)."""
    values = rows.set_index([*FRAME, "seed"])["value"].astype(float)
    if values.index.has_duplicates:
        twice = values.index[values.index.duplicated()][0]
        raise InputError("rows", " ".join(map(str, twice)), "one value of each frame and seed", "several")
    table = values.unstack("seed")
    if table.isna().to_numpy().any():
        frame = table.index[table.isna().any(axis=1)][0]
        raise InputError("rows", " ".join(map(str, frame)), "a finite value in every seed", "none in some")
    return table


def differences(subjects: Sequence[SubjectPairs], less: Sequence[SubjectPairs] = ()) -> FloatArray:
    """(n,) differences of subjects; with ``less``, pairs of another task, minus the difference of the same subject in it.

    Raises `InputError` unless both have the same subjects.
    """
    values = np.array([subject.difference for subject in subjects])
    if not less:
        return values
    names, others = ([subject.subject for subject in each] for each in (subjects, less))
    if names != others:
        raise InputError("rows", "subjects", f"the same in both tasks: {', '.join(names)}", ", ".join(others))
    return values - np.array([subject.difference for subject in less])


REPLICATES = 4_000
LEAST_SUBJECTS = 3
"""Two subjects have one degree of freedom, which is too few for an interval."""


def interval(
    subjects: Sequence[SubjectPairs],
    level: float = 0.05,
    replicates: int = REPLICATES,
    seed: int = 0,
    less: Sequence[SubjectPairs] = (),
) -> tuple[float, float] | None:
    """Confidence interval of the mean difference over the population of subjects, in the metric's unit.

    ``level`` is one minus the confidence; ``seed`` that of the draws; ``less`` that of `differences`. None with fewer
    than `LEAST_SUBJECTS` subjects,
    or where so few have no bounded interval (values without variation within subjects, three subjects).
    """
    count = len(subjects)
    if count < LEAST_SUBJECTS:
        return None
    observed = differences(subjects, less)
    mean, error = observed.mean(), _standard_error(observed)
    if error == 0:
        return float(mean), float(mean)
    generator = np.random.default_rng(seed)
    # Any two entries of a subject's pool are independent draws within it, so a replicate that has the subject twice
    # takes two entries.
    both = zip(subjects, less, strict=True) if less else ((subject,) for subject in subjects)
    pools = np.stack([_means_within(tasks, replicates, generator) for tasks in both])
    drawn = generator.integers(count, size=(replicates, count))
    means = pools[drawn, generator.integers(replicates, size=drawn.shape)]
    shifts, errors = means.mean(axis=1) - mean, _standard_error(means)
    # A replicate of a single subject has no standard error and counts as infinite. Sums of equal numbers
    # differ by rounding.
    alike = errors <= 1e-9 * error
    ratios = np.divide(shifts, errors, out=np.copysign(np.full(replicates, np.inf), shifts), where=~alike)
    # "lower" and "higher" take replicates as they are; between an infinite one and another nothing lies.
    low = np.quantile(ratios, level / 2, method="lower")
    high = np.quantile(ratios, 1 - level / 2, method="higher")
    if not (math.isfinite(low) and math.isfinite(high)):
        return None
    return float(mean - high * error), float(mean - low * error)


def block_length(sequences: Sequence[SequencePairs]) -> int:
    """Timesteps per block: long enough that blocks are nearly independent, at most a third of the sequence.

    The length that is best for the variance of the mean of an autoregressive series, with the correlation of
    neighbours estimated from all sequences together (E. Carlstein, Annals of Statistics 14, 1986; D. Andrews,
    Econometrica 59, 1991).
    """
    series = [sequence.centred for sequence in sequences]
    power = sum(float(values @ values) for values in series)
    product = sum(float(values[1:] @ values[:-1]) for values in series)
    correlation = min(max(product / power, 0.0), 0.99) if power > 0 else 0.0
    length = max(len(values) for values in series)
    best = (math.sqrt(6) * correlation / (1 - correlation**2)) ** (2 / 3) * length ** (1 / 3)
    return max(1, min(math.ceil(best), length // 3))


def _standard_error(values: FloatArray) -> FloatArray:
    """Standard error of means over the last axis."""
    return values.std(axis=-1, ddof=1) / math.sqrt(values.shape[-1])


def _means_within(
    tasks: Sequence[SubjectPairs], replicates: int, generator: np.random.Generator
) -> FloatArray:
    """(replicates,) differences of one subject in a task, minus those in a second one; both are of the same trainings.

    Seeds, sequences and blocks of timesteps are drawn anew.
    """
    # Shares of as many seeds, drawn with replacement.
    shares = [
        generator.multinomial(seeds, np.full(seeds, 1 / seeds), size=replicates) / seeds
        for seeds in map(len, tasks[0].means())
    ]
    means, *less = (_task_draws(task, shares, replicates, generator) for task in tasks)
    return means - less[0] if less else means


def _task_draws(
    subject: SubjectPairs, shares: Sequence[FloatArray], replicates: int, generator: np.random.Generator
) -> FloatArray:
    """(replicates,) differences of one subject for (replicates, S1) and (replicates, S2) ``shares`` of the seeds."""
    first, second = shares
    length = block_length(subject.sequences)
    chosen = generator.integers(len(subject.sequences), size=(replicates, len(subject.sequences)))
    totals = np.zeros(replicates)
    for index, sequence in enumerate(subject.sequences):
        replicate, _ = np.nonzero(chosen == index)
        drawn = _sequence_draws(sequence, length, first[replicate], second[replicate], generator)
        np.add.at(totals, replicate, drawn)
    return totals / len(subject.sequences)


def _sequence_draws(
    sequence: SequencePairs,
    length: int,
    first: FloatArray,
    second: FloatArray,
    generator: np.random.Generator,
) -> FloatArray:
    """(K,) mean differences of a sequence whose blocks are drawn anew, for (K, S1) and (K, S2) shares of the seeds."""
    timesteps = len(sequence.cameras)
    length = min(length, timesteps)
    starts = generator.integers(timesteps, size=(len(first), -(-timesteps // length)))
    cameras = _block_sums(sequence.cameras[None], length)[0][starts].sum(axis=1)
    one, two = (
        _block_sums(values, length)[:, starts].sum(axis=2) for values in (sequence.first, sequence.second)
    )
    return (np.einsum("ks,sk->k", first, one) - np.einsum("ks,sk->k", second, two)) / cameras


def _block_sums(values: FloatArray, length: int) -> FloatArray:
    """(S, T) sums of ``length`` consecutive values from each timestep on, the last followed by the first."""
    wrapped = np.concatenate([np.zeros((len(values), 1)), values, values[:, : length - 1]], axis=1)
    sums = np.cumsum(wrapped, axis=1)
    return sums[:, length:] - sums[:, :-length]
