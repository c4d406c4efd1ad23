"""Two methods' values of one metric, matched frame by frame: what every comparison starts from.

The levels are subject -> sequence -> timestep (with its cameras), and the seeds of each method beside them. Avatars
of different seeds are trained apart, so the seeds of two methods are not paired with each other; the frames are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.rows import FRAME


@dataclass(frozen=True, eq=False)
class SequencePairs:
    """A sequence of one subject, S1 and S2 seeds, T timesteps in order.

    Attributes
    ----------
    first, second : (S1, T) and (S2, T) sums over the cameras of each timestep.
    cameras : (T,) how many there are.
    """

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

    Raises `InputError` where the two do not have values of exactly the same frames, in every seed: a difference
    of means over different frames is none of the methods'.
    """
    tables = [_by_seed(rows) for rows in (first, second)]
    unmatched = tables[0].index.symmetric_difference(tables[1].index)
    if len(unmatched):
        where = " ".join(map(str, unmatched[0]))
        raise InputError("rows", where, "a value of both methods", f"{len(unmatched)} frames with one alone")
    joined = pd.concat(tables, axis=1, keys=["first", "second"]).sort_index()
    subjects: dict[str, list[SequencePairs]] = {}
    for (subject, _), part in joined.groupby(level=["subject", "sequence"], sort=True):
        timesteps = part.groupby(level="timestep", sort=True)
        sums = timesteps.sum()
        sequence = SequencePairs(
            sums["first"].to_numpy().T,
            sums["second"].to_numpy().T,
            np.asarray(timesteps.size(), dtype=np.float64),
        )
        subjects.setdefault(str(subject), []).append(sequence)
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
