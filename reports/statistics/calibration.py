"""``headbench doctor stress statistics``: tests and intervals on paired differences that are drawn from a known population."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.signal import lfilter

from ...bench.benchmarks import Row, findings
from ...bench.contracts import FloatArray, Progress
from ...bench.specs import CommandResult
from .comparisons import best_set, equivalence_p, least_p, sign_flip_p
from .paired import LEVEL, interval


@dataclass(frozen=True)
class Population:
    """Subjects with sequences of frames with correlated errors, and seeds; for example in dB.

    Attributes
    ----------
    mean : float
        Mean difference over the population, which an interval should cover. 0 is the null hypothesis.
    subject_sd, sequence_sd, frame_sd : float
        Standard deviation at each level.
    correlation : float
        Correlation of consecutive frames (a stationary autoregressive series of order 1).
    seeds, seed_sd : int or float
        Number of trainings of each method and subject, and standard deviation of a subject's mean
        between trainings.
    skewed : bool
        Whether the subjects' differences are centred exponential instead of normal.
    """

    subjects: int
    sequences: int = 4
    timesteps: int = 150
    mean: float = 0.0
    subject_sd: float = 0.25
    sequence_sd: float = 0.15
    frame_sd: float = 0.4
    correlation: float = 0.95
    seeds: int = 1
    seed_sd: float = 0.0
    skewed: bool = False

    def draw(self, generator: np.random.Generator) -> FloatArray:
        """Draw the (subjects, sequences, timesteps) differences of frames, means over seeds."""
        shape = (self.subjects, self.sequences, self.timesteps)
        draw = generator.standard_exponential if self.skewed else generator.standard_normal
        levels = draw(shape[:1]) - (1 if self.skewed else 0)
        values = self.frame_sd * self._series(shape, generator)
        values += self.mean + self.subject_sd * levels[:, None, None]
        values += self.sequence_sd * generator.standard_normal(shape[:2])[:, :, None]
        first, second = self.seed_sd * generator.standard_normal((2, self.subjects, self.seeds)).mean(axis=-1)
        values += (first - second)[:, None, None]
        return values

    def _series(self, shape: tuple[int, ...], generator: np.random.Generator) -> FloatArray:
        """Return autoregressive series of unit variance along the last axis."""
        steps = generator.standard_normal(shape)
        steps[..., 1:] *= np.sqrt(1 - self.correlation**2)
        return lfilter([1.0], [1.0, -self.correlation], steps, axis=-1)


TRIALS, QUICK_TRIALS = 2_000, 100
RANGE = (0.03, 0.07)
"""Range around 5 % of two standard errors of the simulation."""

CASES: Mapping[str, Population] = {
    "3 subjects": Population(3),
    "5 subjects": Population(5),
    "6 subjects": Population(6),
    "7 subjects": Population(7),
    "9 subjects": Population(9),
    "9 subjects, not the null": Population(9, mean=0.3),
    "9 subjects, one sequence": Population(9, sequences=1),
    "9 subjects, hardly differing": Population(9, subject_sd=0.02),
    "9 subjects, 3 seeds": Population(9, seeds=3, seed_sd=0.3),
    "9 subjects, skewed": Population(9, skewed=True),
    "20 subjects": Population(20),
}


def stress(quick: bool, progress: Progress) -> CommandResult:
    """Calibrate every case of `CASES` and the sets of the best; passed if the level is kept as specified."""
    trials = QUICK_TRIALS if quick else TRIALS
    cases: list[Row] = []
    for index, (case, population) in enumerate(CASES.items()):
        progress(index, len(CASES) + 1, case)
        cases.append({"simulated": case, **calibrate(population, trials)})
    sets: list[Row] = []
    for advantage in (0.0, 0.25, 0.5):
        left_out, kept = best_set_errors(5, 9, trials, advantage)
        sets.append({"best by dB": advantage, "left out %": 100 * left_out, "others marked %": 100 * kept})
    alike: list[Row] = [
        {
            "true difference, dB": mean,
            "differences": "skewed" if skewed else "symmetric",
            "called equivalent %": 100 * equivalence_share(9, trials, mean, skewed=skewed),
        }
        for skewed in (True, False)
        for mean in (0.0, MARGIN / 2, MARGIN)
    ]
    error = standard_error(trials)
    faults = [f"{row['simulated']}: not as promised" for row in cases if row["verdict"] == BROKEN]
    limit = 100 * (LEVEL + 2 * error)
    faults += [f"best by {row['best by dB']:g} dB: left out" for row in sets if row["left out %"] > limit]
    if alike[-1]["called equivalent %"] > limit:
        faults.append("difference of the margin: called equivalent")
    note = (
        f"{trials} trials each; nominal {LEVEL:.0%} tests, {1 - LEVEL:.0%} intervals; standard error {error:.1%}. The best "
        "are of 5\nmethods, 9 subjects (standard deviation 0.25 dB); equivalence is tested "
        f"within {MARGIN:g} dB, with as many subjects of the same\ndeviation; skewed differences are exponential, beyond the assumption of "
        "that test."
    )
    tables = {"Tests and intervals": cases, "Sets of the best": sets, "Equivalence": alike}
    return findings(tables, note, faults)


MARGIN = 0.3


def equivalence_share(subjects: int, trials: int, mean: float, *, skewed: bool = False) -> float:
    """How often `equivalence_p` finds differences of standard deviation 0.25 to be within `MARGIN`, in [0, 1].

    The differences are normal or, if ``skewed``, exponential with a tail above their mean.
    """
    generator = np.random.default_rng(0)
    shape = (trials, subjects)
    drawn = generator.standard_exponential(shape) - 1 if skewed else generator.standard_normal(shape)
    values = mean + 0.25 * drawn
    return float(np.mean([equivalence_p(each, MARGIN) <= LEVEL for each in values]))


BROKEN = "not as promised"


def calibrate(population: Population, trials: int) -> Row:
    """Draw the population ``trials`` times; test and give an interval each time.

    Returns
    -------
    Row
        In %: how often the sign-flip test rejects (None if there are too few subjects to test), how
        often the interval covers the mean, and how often a paired t-test over frames rejects; and a
        verdict on these rates. The exactness of the test assumes differences that are symmetric about
        their mean.
    """
    generator = np.random.default_rng(0)
    rejected = covered = frame_test = 0
    for _ in range(trials):
        frames = population.draw(generator)
        differences = frames.mean(axis=(1, 2)).tolist()
        rejected += sign_flip_p(differences) <= LEVEL
        bounds = interval(differences)
        covered += bounds is not None and bounds[0] <= population.mean <= bounds[1]
        # A paired t-test that treats frames as independent, for comparison only.
        frame_test += float(stats.ttest_1samp(frames.ravel(), 0.0).pvalue) <= LEVEL
    testable, error = least_p(population.subjects) <= LEVEL, standard_error(trials)
    shares = [1 - covered / trials] + [rejected / trials] * (testable and population.mean == 0)
    verdict = "ok"
    if population.skewed:
        verdict = "beyond the test's assumption"
    elif not all(RANGE[0] - 2 * error <= share <= RANGE[1] + 2 * error for share in shares):
        verdict = BROKEN
    return {
        "test rejects %": 100 * rejected / trials if testable else None,
        "interval covers %": 100 * covered / trials,
        "frame t-test rejects %": 100 * frame_test / trials,
        "verdict": verdict,
    }


def standard_error(trials: int) -> float:
    """Of a share that is 5 %."""
    return float(np.sqrt(LEVEL * (1 - LEVEL) / trials))


def best_set_errors(methods: int, subjects: int, trials: int, advantage: float = 0.0) -> tuple[float, float]:
    """Return how often the truly best method is left out of `best_set`, and how many of the others stay in it.

    ``methods`` have subject means of standard deviation 0.25; the first is better than the others, which are
    equal, by ``advantage``.
    """
    generator = np.random.default_rng(0)
    left_out, kept = 0, 0
    for _ in range(trials):
        values = 0.25 * generator.standard_normal((methods, subjects))
        values[0] += advantage
        means = {str(m): {str(s): float(v) for s, v in enumerate(row)} for m, row in enumerate(values)}
        found = best_set(means, higher_is_better=True).methods or frozenset(means)
        left_out += "0" not in found
        kept += len(found - {"0"})
    return left_out / trials, kept / trials / (methods - 1)
