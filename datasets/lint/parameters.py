"""Tracked parameters read file by file: a broken one does not hide the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from ...bench.contracts import FloatArray, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.arrays import read_npz
from ..ga.flame_parameters import Tracking, read_tracking
from ..ga.transforms import FrameEntry
from ..head.arrays import HeadArrays
from ..head.model import HeadModel

OFFSETS = ("static_offset", "dynamic_offset")
"""Arrays with a row per vertex; too large to keep for every timestep."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """One parameter file.

    Attributes
    ----------
    arrays : as stored, but for the per-vertex `OFFSETS`; empty where the file does not read.
    not_finite : names of arrays with NaN or infinite numbers.
    offset_change_m : largest difference of its static offset from the first file's; 0 where it has none.
    dynamic_m : largest entry of its dynamic offset; 0 where it has none.
    pose : None where the head is unknown or the arrays do not fit it.
    error : why there is no pose.
    """

    timestep: int
    path: Path
    arrays: Mapping[str, np.ndarray]
    not_finite: tuple[str, ...]
    offset_change_m: float
    dynamic_m: float
    pose: HeadPose | None
    error: InputError | None


@dataclass(frozen=True, eq=False)
class Subject:
    """The head with the identity of the first timestep that reads, teeth appended if its files have them."""

    tracking: Tracking

    @property
    def head(self) -> HeadArrays:
        """Head model that the parameters fit."""
        return self.tracking.head

    @cached_property
    def _model(self) -> HeadModel:
        return HeadModel(self.head, dtype=torch.float64)

    @cached_property
    def _canonical(self) -> torch.Tensor:
        return self._model.canonical(
            torch.from_numpy(self.tracking.shape.astype(np.float64)),
            torch.from_numpy(self.tracking.static_offset.astype(np.float64)),
        )

    def vertices(self, poses: Sequence[HeadPose]) -> FloatArray:
        """(B, V, 3) metres, in the world of the poses' own sequence."""
        arguments = self._model.pose_arguments(poses)
        posed: FloatArray = self._model(canonical=self._canonical, **arguments).numpy()
        return posed


def read_parameters(
    entries: Sequence[FrameEntry], head: HeadArrays | None, *, progress: Progress = no_progress
) -> tuple[dict[int, Parameters], Subject | None]:
    """Parameters by timestep (of its first frame), and the head and identity that they fit."""
    files: dict[int, Path] = {}
    for entry in entries:
        files.setdefault(entry.timestep, entry.parameters)
    found: dict[int, Parameters] = {}
    subject: Subject | None = None
    first_offset: np.ndarray | None = None
    for done, (timestep, path) in enumerate(sorted(files.items()), start=1):
        progress(done, len(files), "reading parameters")
        try:
            arrays = read_npz(path)
        except InputError as error:
            found[timestep] = Parameters(timestep, path, {}, (), 0.0, 0.0, None, error)
            continue
        offset = _numbers(arrays.get("static_offset"))
        if first_offset is None:
            first_offset = offset
        pose = fault = None
        if head is not None:
            try:
                tracking = read_tracking(
                    {timestep: path},
                    subject.head if subject else head,
                    "",
                    teeth="keep" if subject else "auto",
                )
                pose = tracking.poses[timestep]
                subject = subject or Subject(tracking)
            except InputError as error:
                fault = error
        found[timestep] = Parameters(
            timestep=timestep,
            path=path,
            arrays={name: array for name, array in arrays.items() if name not in OFFSETS},
            not_finite=tuple(name for name, array in arrays.items() if not _is_finite(array)),
            offset_change_m=_largest_difference(offset, first_offset),
            dynamic_m=float(np.abs(_numbers(arrays.get("dynamic_offset"))).max(initial=0.0)),
            pose=pose,
            error=fault,
        )
    return found, subject


def _numbers(array: np.ndarray | None) -> np.ndarray:
    """The array where it holds finite numbers, else an empty one."""
    usable = array is not None and array.dtype.kind in "fiu" and _is_finite(array)
    return array if array is not None and usable else np.empty(0)


def _is_finite(array: np.ndarray) -> bool:
    return array.dtype.kind not in "f" or bool(np.isfinite(array).all())


def _largest_difference(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).max(initial=0.0)) if one.shape == other.shape else 0.0
