"""Signals of tracked heads: folders of FLAME parameters as VHAP and GaussianAvatars write them, and captures."""

from __future__ import annotations

from pathlib import Path

from ...bench.errors import InputError
from ..ga.layout import Declaration
from ..ga.tracking import POSE_SIZES, find_head, read_animation, read_tracking
from .signal import AVATAR, DrivingSignal, SignalRequest
from .table import SignalTable, in_order

USUAL_HEAD = "flame2023"
"""Head model of VHAP."""

IDENTITY_UNUSED = {"shape": "identity", "static_offset": "identity"}


def is_flame_parameters(table: SignalTable) -> bool:
    """Whether a table has the arrays of VHAP's parameter files."""
    return {*POSE_SIZES, "expr"} <= {*table.columns} and (
        table.path.is_dir() or table.path.suffix.lower() == ".npz"
    )


def read_flame_parameters(request: SignalRequest) -> DrivingSignal:
    """Poses of a folder with a parameter file for each frame, or of one file. Identity stays behind.

    The head model is the one given, else that which a declaration of headbench beside the folder names, else the avatar's if
    it is VHAP's.
    """
    path = request.path
    declaration = Declaration.read(path.parent) if path.is_dir() and not request.signal_head else None
    head = find_head(path.parent, declaration, None) if declaration else request.head(USUAL_HEAD)
    if path.is_dir():
        files = dict(enumerate(sorted(path.glob("*.npz"), key=in_order)))
        tracking = read_tracking(files, head, "")
    else:
        tracking = read_animation(path, head)
    poses = [tracking.poses[timestep] for timestep in sorted(tracking.poses)]
    unused = {**IDENTITY_UNUSED, **{k: v for k, v in tracking.notes.items() if k == "eyelids"}}
    if tracking.notes.get("dynamic_offset_ignored_m"):
        unused["dynamic_offset"] = "offsets of vertices"
    return DrivingSignal("flame_param", tracking.head, poses, unused)


def read_capture_signal(request: SignalRequest) -> DrivingSignal:
    """Poses of a capture of any layout, of all its sequences or one of them, in the order of time.

    Raises `InputError` for an unknown sequence.
    """
    head = request.signal_head if request.signal_head != AVATAR else ""
    options = {"head": head} if head and Path(head).exists() else {}
    clip = request.options.open(str(request.path), request.progress, **options)
    sequences = {key.timestep: key.sequence for key in sorted(clip.files)}
    names = sorted({*sequences.values()})
    if request.sequence and request.sequence not in names:
        raise InputError("command line", "--sequence", f"one of {', '.join(names)}", request.sequence)
    timesteps = [t for t in sorted(clip.poses) if request.sequence in ("", sequences.get(t))]
    return DrivingSignal("capture", clip.head, [clip.poses[t] for t in timesteps], IDENTITY_UNUSED)
