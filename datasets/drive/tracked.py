"""Signals of tracked heads: folders of FLAME parameters as VHAP and GaussianAvatars write them, and captures."""

from __future__ import annotations

from pathlib import Path

from ...bench.errors import InputError
from ..ga.layout import Declaration
from ..ga.tracking import POSE_SIZES, find_head, read_animation, read_tracking
from .signal import AVATAR, DrivingSignal, SignalRequest
from .table import SignalTable, natural_order

DEFAULT_HEAD = "flame2023"
"""Head model of VHAP."""

IDENTITY_UNUSED = {"shape": "identity", "static_offset": "identity"}


def is_flame_parameters(table: SignalTable) -> bool:
    """Whether a table has the arrays of VHAP's parameter files."""
    files = [*table.path.glob("*.npz")] if table.path.is_dir() else [table.path]
    return {*POSE_SIZES, "expr"} <= {*table.columns} and any(file.suffix.lower() == ".npz" for file in files)


def read_flame_parameters(request: SignalRequest) -> DrivingSignal:
    """Poses of a folder with a parameter file for each frame, or of one file. Identity is ignored.

    The head model is the one given, else that which a declaration of headbench beside the folder names, else the avatar's if
    it is VHAP's.
    """
    path = request.path
    declaration = Declaration.read(path.parent) if path.is_dir() and not request.signal_head else None
    head = find_head(path.parent, declaration, None) if declaration else request.head(DEFAULT_HEAD)
    if path.is_dir():
        files = dict(enumerate(sorted(path.glob("*.npz"), key=natural_order)))
        if not files:
            raise InputError(path, "", "a .npz file of parameters for each frame", "none")
        tracking = read_tracking(files, head, "")
    else:
        tracking = read_animation(path, head)
    poses = [tracking.poses[timestep] for timestep in sorted(tracking.poses)]
    unused = {**IDENTITY_UNUSED, **{k: v for k, v in tracking.notes.items() if k == "eyelids"}}
    if tracking.notes.get("dynamic_offset_ignored_m"):
        unused["dynamic_offset"] = "offsets of vertices"
    return DrivingSignal("flame_param", tracking.head, poses, unused)


def read_capture_signal(request: SignalRequest) -> DrivingSignal:
    """Poses of one sequence of a capture of any layout, without excluded frames, in the order of time.

    Raises `InputError` for an unknown sequence, and for none where the capture has several.
    """
    head = request.signal_head if request.signal_head != AVATAR else ""
    if head and not Path(head).exists():
        expected = "the file of a head model, for a signal that is a capture"
        raise InputError("command line", "--signal-head", expected, head)
    options = {"head": head} if head else {}
    clip = request.options.open(str(request.path), request.progress, **options)
    sequences = {key.timestep: key.sequence for key in sorted(clip.files)}
    names = sorted({*sequences.values()})
    if request.sequence and request.sequence not in names:
        raise InputError("command line", "--sequence", f"one of {', '.join(names)}", request.sequence)
    if len(names) > 1 and not request.sequence:
        remedy = "Choose one sequence: poses are smoothed over time, which must not join two sequences."
        raise InputError("command line", "--sequence", f"one of {', '.join(names)}", "none", remedy)
    left_out = {key.timestep for key in clip.excluded}
    timesteps = [
        t for t in sorted(clip.poses) if t not in left_out and request.sequence in ("", sequences.get(t))
    ]
    if not timesteps:
        raise InputError(request.path, request.sequence, "frames that are not excluded", "none")
    return DrivingSignal("capture", clip.head, [clip.poses[t] for t in timesteps], IDENTITY_UNUSED)
