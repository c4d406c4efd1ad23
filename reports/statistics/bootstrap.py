"""Confidence intervals of a mean paired difference by a hierarchical, studentised bootstrap.

A replicate draws subjects; within each drawn one, seeds of both methods and sequences; within each drawn sequence,
circular blocks of consecutive timesteps (frames of a video are alike, and all cameras of a timestep stay together);
all with replacement. The population is subjects: the interval is about new people, not about further frames of
these.

Percentiles of the replicates' means are too narrow for few subjects, and drawing within subjects counts the lower
levels twice. Both cancel in the studentised form: the distribution of (mean* - mean) / error*, where error* is the
standard error from the replicate's own subject means, stands in for that of the observed ratio (B. Efron and
R. Tibshirani, An Introduction to the Bootstrap, 1993, section 12.5; A. Davison and D. Hinkley, Bootstrap Methods
and their Application, 1997, sections 3.8 and 8.2.3). `calibration` shows what it covers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ...bench.contracts import FloatArray
from .pairs import SequencePairs, SubjectPairs

REPLICATES = 4_000
LEAST_SUBJECTS = 3
"""Two subjects have one degree of freedom; an interval from them says nothing."""


def interval(
    subjects: Sequence[SubjectPairs], level: float = 0.05, replicates: int = REPLICATES, seed: int = 0
) -> tuple[float, float] | None:
    """Confidence interval of the mean difference over the population of subjects.

    Parameters
    ----------
    level : one minus the confidence.
    seed : of the draws; the same input gives the same interval.

    Returns
    -------
    (low, high) in the metric's unit, or None with fewer than `LEAST_SUBJECTS` subjects, or where so few have no
    bounded interval (values without variation within subjects, three subjects).
    """
    count = len(subjects)
    if count < LEAST_SUBJECTS:
        return None
    observed = np.array([subject.difference for subject in subjects])
    mean, error = observed.mean(), _standard_error(observed)
    if error == 0:
        return float(mean), float(mean)
    generator = np.random.default_rng(seed)
    # Any two entries of a subject's pool are independent draws within it, so a replicate that has the subject twice
    # takes two entries.
    pools = np.stack([_means_within(subject, replicates, generator) for subject in subjects])
    drawn = generator.integers(count, size=(replicates, count))
    means = pools[drawn, generator.integers(replicates, size=drawn.shape)]
    shifts, errors = means.mean(axis=1) - mean, _standard_error(means)
    # A replicate of one subject alone has no error of its own: as far out as can be. Sums of equal numbers
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
    """Return the standard error of means over the last axis."""
    return values.std(axis=-1, ddof=1) / math.sqrt(values.shape[-1])


def _means_within(subject: SubjectPairs, replicates: int, generator: np.random.Generator) -> FloatArray:
    """(replicates,) differences of one subject, its seeds, sequences and blocks of timesteps drawn anew."""
    length = block_length(subject.sequences)
    first, second = (_seed_weights(len(means), replicates, generator) for means in subject.means())
    chosen = generator.integers(len(subject.sequences), size=(replicates, len(subject.sequences)))
    totals = np.zeros(replicates)
    for index, sequence in enumerate(subject.sequences):
        replicate, _ = np.nonzero(chosen == index)
        drawn = _sequence_draws(sequence, length, first[replicate], second[replicate], generator)
        np.add.at(totals, replicate, drawn)
    return totals / len(subject.sequences)


def _seed_weights(seeds: int, replicates: int, generator: np.random.Generator) -> FloatArray:
    """(replicates, seeds) shares of as many seeds, drawn with replacement."""
    return generator.multinomial(seeds, np.full(seeds, 1 / seeds), size=replicates) / seeds


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
