"""Paired differences as a benchmark of head avatars has them, drawn from a known population."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from scipy import stats
from scipy.signal import lfilter

from ...bench.contracts import FloatArray, Progress, no_progress
from ...bench.specs import Findings
from ...reports.statistics.bootstrap import SequencePairs, SubjectPairs, interval
from ...reports.statistics.comparisons import LEVEL, best_set, least_p, sign_flip_p


@dataclass(frozen=True)
class Population:
    """Subjects with sequences with frames whose errors follow each other, and seeds beside them; in dB, say.

    Attributes
    ----------
    mean : of the difference over the population: what an interval should cover. 0 is the null.
    subject_sd, sequence_sd, frame_sd : standard deviation at each level.
    correlation : of neighbouring frames (a stationary autoregressive series of order 1).
    seeds, seed_sd : trainings of each method and subject, and how much a training moves the mean of a subject.
    skewed : the subjects' differences are exponential less their mean instead of normal.
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

    def draw(self, generator: np.random.Generator) -> tuple[SubjectPairs, ...]:
        """Draw subjects; the second method's values are its seeds' deviations alone."""
        shape = (self.subjects, self.sequences, self.timesteps)
        draw = generator.standard_exponential if self.skewed else generator.standard_normal
        levels = draw(shape[:1]) - (1 if self.skewed else 0)
        values = self.frame_sd * self._series(shape, generator)
        values += self.mean + self.subject_sd * levels[:, None, None]
        values += self.sequence_sd * generator.standard_normal(shape[:2])[:, :, None]
        first, second = self.seed_sd * generator.standard_normal((2, self.subjects, self.seeds))
        cameras = np.ones(self.timesteps)

        def pairs(index: int) -> tuple[SequencePairs, ...]:
            one, other = first[index][:, None], cameras * second[index][:, None]
            return tuple(SequencePairs(frames + one, other, cameras) for frames in values[index])

        return tuple(SubjectPairs(f"{index}", pairs(index)) for index in range(self.subjects))

    def _series(self, shape: tuple[int, ...], generator: np.random.Generator) -> FloatArray:
        """Return autoregressive series of unit variance along the last axis."""
        steps = generator.standard_normal(shape)
        steps[..., 1:] *= np.sqrt(1 - self.correlation**2)
        return lfilter([1.0], [1.0, -self.correlation], steps, axis=-1)


TRIALS, QUICK_TRIALS = 2_000, 100
REPLICATES = 1_000
RANGE = (0.03, 0.07)
"""What counts as 5 %, give or take two standard errors of the simulation."""

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


@dataclass(frozen=True)
class Calibration:
    """Shares over the trials.

    Attributes
    ----------
    promised : the population is one that the test's exactness assumes: its differences are symmetric about their mean.
    rejected : of the sign-flip test at the level; None where so few subjects cannot be tested.
    covered : of the intervals.
    frame_test : how often a paired t-test over frames rejects.
    error : standard error of ``rejected`` and of 1 - ``covered`` where they are 5 %.
    """

    case: str
    promised: bool
    null: bool
    trials: int
    rejected: float | None
    covered: float
    frame_test: float
    error: float

    @property
    def as_promised(self) -> bool:
        """Whether the test, on the null, and the interval are within `RANGE`, where that was promised."""
        if not self.promised:
            return True
        shares = [1 - self.covered]
        if self.null and self.rejected is not None:
            shares.append(self.rejected)
        return all(RANGE[0] - 2 * self.error <= share <= RANGE[1] + 2 * self.error for share in shares)


def calibrate(case: str, population: Population, trials: int, seed: int = 0) -> Calibration:
    """Draw the population ``trials`` times; test and give an interval each time."""
    generator = np.random.default_rng(seed)
    rejected = covered = frame_test = 0
    for trial in range(trials):
        subjects = population.draw(generator)
        rejected += sign_flip_p([subject.difference for subject in subjects]) <= LEVEL
        bounds = interval(subjects, LEVEL, REPLICATES, seed=trial)
        covered += bounds is not None and bounds[0] <= population.mean <= bounds[1]
        frame_test += frame_t_test_p(subjects) <= LEVEL
    return Calibration(
        case,
        not population.skewed,
        population.mean == 0,
        trials,
        rejected / trials if least_p(population.subjects) <= LEVEL else None,
        covered / trials,
        frame_test / trials,
        float(np.sqrt(LEVEL * (1 - LEVEL) / trials)),
    )


def frame_t_test_p(subjects: tuple[SubjectPairs, ...]) -> float:
    """P-value of a paired t-test that takes frames for independent: here only to show what it does."""
    sequences = [sequence for subject in subjects for sequence in subject.sequences]
    frames = [(each.first.mean(axis=0) - each.second.mean(axis=0)) / each.cameras for each in sequences]
    return float(stats.ttest_1samp(np.concatenate(frames), 0.0).pvalue)


def best_set_errors(
    methods: int, subjects: int, trials: int, advantage: float = 0.0, seed: int = 0
) -> tuple[float, float]:
    """Return how often the truly best method is left out of `best_set`, and how many of the others stay in it.

    ``methods`` have subject means of standard deviation 0.25; the first is better than the others, which are
    equal, by ``advantage``.
    """
    generator = np.random.default_rng(seed)
    left_out, kept = 0, 0
    for _ in range(trials):
        values = 0.25 * generator.standard_normal((methods, subjects))
        values[0] += advantage
        means = {str(m): {str(s): float(v) for s, v in enumerate(row)} for m, row in enumerate(values)}
        found = best_set(means, higher_is_better=True).methods or frozenset(means)
        left_out += "0" not in found
        kept += len(found - {"0"})
    return left_out / trials, kept / trials / (methods - 1)


def run(quick: bool = False, progress: Progress = no_progress) -> Findings:
    """Calibrate every case of `CASES` and the sets of the best."""
    trials = QUICK_TRIALS if quick else TRIALS
    results = []
    for index, (case, population) in enumerate(CASES.items()):
        progress(index, len(CASES) + 1, case)
        results.append(calibrate(case, population, trials))
    advantages = (0.0, 0.25, 0.5)
    sets = [(advantage, *best_set_errors(5, 9, trials, advantage)) for advantage in advantages]
    progress(len(CASES) + 1, len(CASES) + 1, "sets of the best")
    nominal = f"nominal {LEVEL:.0%} tests, {1 - LEVEL:.0%} intervals"
    lines = [
        f"{trials} trials each; {nominal}; standard error {results[0].error:.1%}",
        "",
        f"{'simulated':<32}{'sign-flip test':>16}{'interval':>12}{'frame t-test':>16}",
        f"{'':<32}{'rejects':>16}{'covers':>12}{'rejects':>16}",
    ]
    for result in results:
        rejected = "not testable" if result.rejected is None else f"{result.rejected:.1%}"
        mark = "" if result.as_promised else "  not as promised"
        mark = mark if result.promised else "  beyond the test's assumption"
        lines.append(
            f"{result.case:<32}{rejected:>16}{result.covered:>12.1%}{result.frame_test:>16.1%}{mark}"
        )
    lines += ["", "Best of 5 methods, 9 subjects (standard deviation 0.25 dB):"]
    for advantage, left_out, kept in sets:
        lines.append(
            f"  best by {advantage:.2f} dB: left out in {left_out:.1%}, each other one marked in {kept:.1%}"
        )
    limit = LEVEL + 2 * results[0].error
    passed = all(result.as_promised for result in results) and all(out <= limit for _, out, _ in sets)
    data = {
        "level": LEVEL,
        "cases": [{**asdict(result), "as_promised": result.as_promised} for result in results],
        "best_sets": [{"advantage": a, "left_out": out, "others_marked": kept} for a, out, kept in sets],
    }
    return Findings("\n".join(lines), data, passed)
