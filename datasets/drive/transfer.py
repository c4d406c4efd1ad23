"""Transfer of a signal to the head model of an avatar, relative to the signal's neutral face, and smoothing over time.

Signals whose frames arrive one by one, as lines of JSON.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import savgol_filter

from ...bench.contracts import FloatArray, FrameKey, HeadAsset, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.experiments.reenactment import AT_ORIGIN, RigidMean, retarget
from ..clip import CaptureClip, FrameFiles, without_images
from ..head.arrays import HeadArrays
from ..head.model import PosedSubject, resting
from ..head.refit.identity import match
from ..head.refit.refit import BlockFitter, refit
from ..head.refit.settings import RefitSettings
from ..head.rotations import rotation_of
from ..head.teeth import with_teeth_where_possible
from .formats import read_rows
from .signal import NO_EYELIDS, DrivingSignal, SignalRequest
from .table import SignalTable, parse_line
from .timing import GAP, Timing

SMOOTHED = ("expression", "jaw", "eyes", "eyelids", "neck", "rotation", "translation")
KEEP_NECK = RefitSettings(neck="keep")
ROUNDED = 0.1
"""Frames by which the time of the last frame may be too early."""
ORDER = 2
"""Order of the polynomials of the Savitzky-Golay filter."""


class Transferred(NamedTuple):
    """A signal on the head model of an avatar."""

    read: Sequence[HeadPose]
    """Poses of the avatar's head model, before a neutral face is subtracted."""
    poses: Sequence[HeadPose]
    """Poses relative to the neutral face."""
    residual_mm: float | None
    """Mean distance of the facial vertices after a refit between head models, millimetres; None if none was needed."""
    unused: dict[str, str]
    """Channels lost in the transfer."""


def transfer(
    signal: DrivingSignal, target: HeadArrays, neutral: int | None, progress: Progress = no_progress
) -> Transferred:
    """Bring a signal to a head model by `refit`, on the vertices of the signal's mean head, so that no identity is transferred.

    ``neutral``: Frame of the signal with the neutral face; None takes the neutral face of the signal's head model.
    """
    poses = list(signal.poses)
    if neutral is not None and neutral >= len(poses):
        expected = f"a frame of the signal, from 0 to {len(poses) - 1}"
        raise InputError("command line", "--neutral", expected, str(neutral))
    if same_basis(signal.head, target):
        lost = target.eyelid_basis is None and any(
            pose.eyelids is not None and np.any(pose.eyelids) for pose in poses
        )
        read = [replace(p, eyelids=_eyelids(p, target)) for p in poses]
        origin = None if neutral is None else read[neutral]
        return Transferred(
            read, relative_to_neutral(read, origin), None, {"eyelids": NO_EYELIDS} if lost else {}
        )
    source = with_teeth_of(target, signal.head)
    moving = {t: replace(pose, timestep=t) for t, pose in enumerate([*poses, resting(source)])}
    refitted = refit(clip_of_poses(source, moving), target, KEEP_NECK, progress=progress)
    found = [refitted.clip.poses[t] for t in sorted(moving)]
    read, rest = found[:-1], found[-1]
    residual = float(np.mean([frame.mean_mm for frame in refitted.report.frames[:-1]]))
    return Transferred(
        read, relative_to_neutral(read, rest if neutral is None else read[neutral]), residual, {}
    )


class FrameTransfer:
    """`transfer` frame by frame, for live signals.

    ``source``, ``target``: Head models of the signal and of the avatar.
    """

    def __init__(self, source: HeadArrays, target: HeadArrays):
        self._target, self._fitter = target, None
        if not same_basis(source, target):
            source = with_teeth_of(target, source)
            clip = clip_of_poses(source, {0: resting(source)})
            matching = match(source, PosedSubject.of(clip).neutral, target, KEEP_NECK)
            self._fitter = BlockFitter(clip, target, matching, np.zeros(target.template.shape), KEEP_NECK)
            self._rest = self._fitted(self._fitter, resting(source))

    def __call__(self, pose: HeadPose) -> HeadPose:
        """The pose on the target, relative to the neutral face of the source."""
        if self._fitter is None:
            return replace(pose, eyelids=_eyelids(pose, self._target))
        return relative_to_neutral([self._fitted(self._fitter, pose)], self._rest)[0]

    @staticmethod
    def _fitted(fitter: BlockFitter, pose: HeadPose) -> HeadPose:
        return fitter.pose(pose, None, fitter.fit([pose]), 0)


def clip_of_poses(head: HeadArrays, poses: Mapping[int, HeadPose]) -> CaptureClip:
    """A clip of the mean head in poses, without images."""
    keys = {FrameKey("signal", "signal", t, "none"): FrameFiles(None, None) for t in poses}
    return CaptureClip(
        subject="signal",
        shape=np.zeros(head.shape_basis.shape[2]),
        splits={"train": tuple(keys), "novel_view": (), "self_reenactment": ()},
        files=keys,
        **without_images(head, poses),
    )


def with_teeth_of(target: HeadArrays, source: HeadArrays) -> HeadArrays:
    """The source with teeth, if it differs from the target's mesh by them alone: then vertices of one index are one point."""
    teeth = len(target.regions.get("teeth", ()))
    if teeth and "teeth" not in source.regions and len(source.template) + teeth == len(target.template):
        return with_teeth_where_possible(source)
    return source


def same_basis(one: HeadArrays, other: HeadArrays) -> bool:
    """Whether coefficients of two head models mean the same."""
    return one.version == other.version and one.expression_basis.shape[2] == other.expression_basis.shape[2]


def relative_to_neutral(poses: Sequence[HeadPose], neutral: HeadPose | None) -> list[HeadPose]:
    """Poses relative to a neutral face: differences of coefficients, relative rotations of jaw and eyes."""
    if neutral is None:
        return list(poses)
    return [
        replace(
            pose,
            expression=pose.expression - neutral.expression,
            jaw=_relative_rotation(neutral.jaw, pose.jaw),
            eyes=_relative_rotation(neutral.eyes, pose.eyes),
            eyelids=None
            if pose.eyelids is None or neutral.eyelids is None
            else pose.eyelids - neutral.eyelids,
        )
        for pose in poses
    ]


def head_motion(poses: Sequence[HeadPose], still: bool) -> list[HeadPose]:
    """Poses whose head moves around the origin, relative to its mean over time; not at all if ``still``."""
    if still:
        return [replace(p, rotation=np.zeros(3), neck=np.zeros(3), translation=np.zeros(3)) for p in poses]
    mean = RigidMean.of(poses)
    return [retarget(pose, mean, AT_ORIGIN, pose.subject) for pose in poses]


def resampled(
    path: Path, poses: Sequence[HeadPose], timing: Timing, fps: float
) -> tuple[list[HeadPose], list[tuple[int, int]]]:
    """Poses at ``fps``, and the first and last number of each series of them that no frame of the signal is near to.

    Between two frames poses are interpolated linearly, head rotations on the shortest path; before the first and after the
    last they are held. Signals that state no rate have ``fps``.
    """
    positions, total = timing.positions, round(timing.last) + 1
    if 2 * len(positions) < total:
        steps = np.diff(positions, append=timing.last)
        longest = int(positions[steps.argmax()]) + 1
        expected = f"a face in half of its {total} frames or more"
        found = f"{len(positions)}; longest gap: {round(steps.max() - 1)} frames from frame {longest}"
        raise InputError(path, timing.column, expected, found, "Keep a part of the signal without long gaps.")
    step = (timing.fps or fps) / fps
    times = step * np.arange(int(timing.last / step + ROUNDED) + 1)
    after = np.searchsorted(positions, times).clip(1, max(1, len(positions) - 1)) % len(positions)
    before = np.maximum(after - 1, 0)
    nearest = np.minimum(abs(times - positions[before]), abs(times - positions[after]))
    if len(times) == len(poses) and nearest.max() < 1e-6:
        return list(poses), []
    share = (times - positions[before]) / np.maximum(positions[after] - positions[before], 1e-9)
    share = share.clip(0, 1)[:, None]
    columns = {}
    for name in SMOOTHED:
        values = [getattr(pose, name) for pose in poses]
        if values[0] is not None:
            array = np.array(values, np.float64)
            columns[name] = (1 - share) * array[before] + share * array[after]
    rotations = rotation_of(np.array([pose.rotation for pose in poses]))
    turns = (rotations[before].inv() * rotations[after]).as_rotvec()
    columns["rotation"] = (rotations[before] * rotation_of(share * turns)).as_rotvec()
    converted = [
        replace(poses[row], **{name: values[number] for name, values in columns.items()})
        for number, row in enumerate(before)
    ]
    filled = np.flatnonzero(np.diff(nearest > GAP / 2, prepend=False, append=False)).reshape(-1, 2)
    return converted, [(int(first), int(end) - 1) for first, end in filled]


def window_length(frames: int, seconds: float, fps: float) -> int:
    """Odd number of frames of a window of ``seconds``; 0 for no window."""
    if not seconds:
        return 0
    window = 2 * round((seconds * fps - 1) / 2) + 1
    if not ORDER + 2 <= window <= frames:
        expected = f"a window of {ORDER + 3} to {frames} frames, {(ORDER + 3) / fps:g} s or more"
        found = f"{seconds:g} s, {window} frames at {fps:g} a second"
        raise InputError("command line", "--smooth", expected, found)
    return window


def smoothed(poses: Sequence[HeadPose], seconds: float, fps: float) -> list[HeadPose]:
    """Poses filtered over time by least-squares polynomials of `ORDER` in a moving window.

    Savitzky and Golay, "Smoothing and differentiation of data by simplified least squares procedures", Anal. Chem. 36, 1964,
    by `scipy.signal.savgol_filter`. The window has the odd number of frames nearest to ``seconds``.
    """
    if not seconds:
        return list(poses)
    window = window_length(len(poses), seconds, fps)
    columns = {}
    for name in SMOOTHED:
        values = [getattr(pose, name) for pose in poses]
        if values[0] is not None:
            columns[name] = savgol_filter(np.array(values, np.float64), window, ORDER, axis=0)
    return [
        replace(p, **{name: values[row] for name, values in columns.items()}) for row, p in enumerate(poses)
    ]


def _relative_rotation(neutral: FloatArray, angles: FloatArray) -> FloatArray:
    """Axis-angle vectors, (3 n,), of the rotations from ``neutral`` to ``angles``."""
    reference, rotation = (rotation_of(part.reshape(-1, 3)) for part in (neutral, angles))
    return np.asarray((reference.inv() * rotation).as_rotvec()).reshape(-1)


def _eyelids(pose: HeadPose, target: HeadArrays) -> FloatArray | None:
    """Eyelids of a pose as the target has them."""
    if target.eyelid_basis is None:
        return None
    return np.zeros(target.eyelid_basis.shape[2]) if pose.eyelids is None else pose.eyelids


class LiveDriver:
    """Converts lines of one frame each (coefficients or blendshapes, as for `read_signal`) to poses of a head model.
    ``target``: Head model of the avatar. ``signal_head``: See `settings.DriveSettings`."""

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
        """The pose of a line; the head moves around the origin, relative to the first line."""
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
