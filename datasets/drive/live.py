"""Signals whose frames arrive one by one, as lines of JSON."""

from __future__ import annotations

from pathlib import Path

from ...bench.contracts import HeadAsset, HeadPose
from ...bench.errors import InputError
from ...bench.experiments.reenactment import AT_ORIGIN, RigidMean, retarget
from ..head.arrays import HeadArrays
from .formats import read_rows
from .signal import SignalRequest
from .table import SignalTable, parse_line
from .timing import Timing
from .transfer import FrameTransfer


class LiveDriver:
    """Converts lines of one frame each (coefficients or blendshapes, as for `read_signal`) to poses of a head model.

    Parameters
    ----------
    target : HeadAsset
        Head model of the avatar.
    signal_head : str
        See `settings.DriveSettings`.
    """

    def __init__(self, target: HeadAsset, signal_head: str = ""):
        if not isinstance(target, HeadArrays):
            raise InputError(
                "avatar", "head", "a head model of headbench's own arrays", type(target).__name__
            )
        self._target, self._signal_head = target, signal_head
        if signal_head:
            SignalRequest(
                Path("live signal"), target, signal_head=signal_head
            ).head()  # Raises for a file that cannot be read.
        self._transfer: dict[str, FrameTransfer] = {}
        self._first: RigidMean | None = None

    def __call__(self, line: str) -> HeadPose:
        """The pose of a line; the head moves around the origin, relative to the first line.

        Raises `InputError` for a line that is not a frame of a known format.
        """
        path = Path("live signal")
        frame = parse_line(line, path, "line")
        if not frame:
            raise InputError(path, "line", "values of a frame with a face", "none")
        columns = {name: [value] for name, value in frame.items()}
        table = SignalTable(path, columns, ["line"], Timing.regular(1))
        signal = read_rows(SignalRequest(path, self._target, table, self._signal_head))
        version = signal.head.version
        if version not in self._transfer:
            self._transfer[version] = FrameTransfer(signal.head, self._target)
        pose = self._transfer[version](signal.poses[0])
        self._first = self._first or RigidMean.of([pose])
        return retarget(pose, self._first, AT_ORIGIN, pose.subject)
