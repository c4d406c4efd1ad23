"""A driving signal as poses of a head model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ..head.arrays import HeadArrays
from ..head.refit.command import target_head
from ..options import CaptureOptions
from .table import SignalTable
from .timing import Timing

POSE_PARTS = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
"""Parts of a pose beside expression and eyelids, and their numbers."""

NO_EYELIDS = "the head model has no eyelid basis"
AVATAR = "avatar"
"""Name of the avatar's own head model in ``--signal-head``."""


@dataclass(frozen=True, eq=False)
class DrivingSignal:
    """A driving signal.

    Attributes
    ----------
    form : str
        Name of its format.
    head : HeadArrays
        Head model of its poses.
    poses : Sequence[HeadPose]
        One for each frame, at least one.
    timing : Timing
        Times of the poses.
    unused : Mapping[str, str]
        Channels of the signal that drive nothing, each with the reason.
    """

    form: str
    head: HeadArrays
    poses: Sequence[HeadPose]
    timing: Timing
    unused: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class SignalRequest:
    """Input of a reader of signals; see `settings.DriveSettings` for the fields of the same name.

    Attributes
    ----------
    path : Path
        File or folder of the signal.
    target : HeadArrays
        Head model of the avatar.
    table : SignalTable | None
        Content of a signal that is a table.
    """

    path: Path
    target: HeadArrays
    table: SignalTable | None = None
    signal_head: str = ""
    map: str = ""
    sequence: str = ""
    fps: float | None = None
    options: CaptureOptions = field(default_factory=CaptureOptions)
    progress: Progress = no_progress

    @property
    def columns(self) -> SignalTable:
        """The table. Raises `InputError` if the signal is not a table."""
        if self.table is None:
            raise InputError(self.path, "", "a table of numbers, or files of each frame", "a capture")
        return self.table

    def head(self, default: str = "") -> HeadArrays:
        """Head model of the signal's coefficients: the one given, or the avatar's if that is ``default`` ("" for any).

        Raises `InputError` if it is not given and has to be.
        """
        if self.signal_head and self.signal_head != AVATAR:
            return _loaded(self.signal_head)
        if self.signal_head == AVATAR or default in ("", self.target.version):
            return self.target
        expected = f"the head model of the signal, as the avatar's is {self.target.version}"
        remedy = f"Signals of this format usually are of {default}. Name its file, or `{AVATAR}` if they are of the avatar's."
        raise InputError("command line", "--signal-head", expected, "none", remedy)


@lru_cache(maxsize=2)
def _loaded(name: str) -> HeadArrays:
    """A head model, which the frames of a live signal share."""
    return target_head(name, "--signal-head")


def make_poses(path: Path, head: HeadArrays, parts: Mapping[str, FloatArray]) -> list[HeadPose]:
    """Poses of (T, n) arrays by name: expression, eyelids and those of `POSE_PARTS`; missing ones are 0.

    Fewer expression coefficients than the head model has are padded with zeros; eyelids are left out if it has no basis.

    Raises `InputError` for a wrong size, more coefficients than the head model has, and expressions beyond a head's size.
    """
    length = len(next(iter(parts.values())))
    size = head.expression_basis.shape[2]
    lids = 0 if head.eyelid_basis is None else head.eyelid_basis.shape[2]
    columns = {name: np.zeros((length, n)) for name, n in {**POSE_PARTS, "expression": size}.items()}
    for name, values in parts.items():
        if name == "eyelids" and not lids:
            continue
        wanted = POSE_PARTS.get(name, lids if name == "eyelids" else size)
        given = values.shape[1]
        if given > wanted or (given < wanted and name != "expression"):
            expected = f"{'at most ' if name == 'expression' else ''}{wanted} coefficients of {head.version}"
            raise InputError(
                path, name, expected, str(given), "Name the signal's head model with --signal-head."
            )
        columns[name] = np.pad(values, ((0, 0), (0, wanted - given)))
    if lids:
        columns.setdefault("eyelids", np.zeros((length, lids)))
    return [
        HeadPose(head.version, **{name: values[row] for name, values in columns.items()})
        for row in range(length)
    ]
