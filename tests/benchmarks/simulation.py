"""Paired differences as a benchmark of head avatars has them, drawn from a known population."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from ...bench.contracts import FloatArray
from ...reports.statistics.bootstrap import SequencePairs, SubjectPairs


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
        levels = (
            generator.standard_exponential(shape[:1]) - 1
            if self.skewed
            else generator.standard_normal(shape[:1])
        )
        values = self.frame_sd * self._series(shape, generator)
        values += self.mean + self.subject_sd * levels[:, None, None]
        values += self.sequence_sd * generator.standard_normal(shape[:2])[:, :, None]
        first, second = self.seed_sd * generator.standard_normal((2, self.subjects, self.seeds))
        cameras = np.ones(self.timesteps)
        return tuple(
            SubjectPairs(
                f"{index}",
                tuple(
                    SequencePairs(frames + first[index][:, None], cameras * second[index][:, None], cameras)
                    for frames in values[index]
                ),
            )
            for index in range(self.subjects)
        )

    def _series(self, shape: tuple[int, ...], generator: np.random.Generator) -> FloatArray:
        """Return autoregressive series of unit variance along the last axis."""
        steps = generator.standard_normal(shape)
        steps[..., 1:] *= np.sqrt(1 - self.correlation**2)
        return lfilter([1.0], [1.0, -self.correlation], steps, axis=-1)
