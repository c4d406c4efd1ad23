"""Formats of driving signals: how each is recognised and read, with mapped columns and coefficients of a head model.

Formats read:

- EMOCA folders. Written by radekd91/emoca 2.0 (`gdl_apps/EMOCA/utils/io.py`). Not checked on a file of the program.
- INFERNO folders. Written by radekd91/inferno (`inferno_apps/FaceReconstruction/utils/output.py`). Not checked on a file of
  the program.
- DECA coefficients. Written by users from the result of yfeng95/DECA (`decalib/deca.py`, `encode`) or filby89/spectre
  (`src/spectre.py`, `encode`). Not checked on a file of the program.
- SMIRK coefficients. Written by users from the result of georgeretsi/smirk (`src/smirk_encoder.py`). Not checked on a file of
  the program.
- SHeaP coefficients. Written by users from the result of nlml/sheap. Not checked on a file of the program.
- VHAP parameters. Written by ShenhanQian/VHAP (`vhap/export_as_nerf_dataset.py`). Not checked on a file of the program.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.documents import checked, read_yaml
from ...bench.registry import finds, readers, unknown
from ..ga.layout import Declaration
from ..ga.tracking import POSE_SIZES, find_head, read_animation, read_tracking
from ..head.arrays import HeadArrays
from .signal import (
    ARKIT,
    AVATAR,
    NO_EYELIDS,
    POSE_PARTS,
    DrivingSignal,
    SignalRequest,
    apply_blendshapes,
    is_blendshapes,
    make_poses,
    read_blendshapes,
)
from .table import IDENTITY, NAMES, SignalTable, read_table
from .timing import Timing, in_order

TRACKED_HEAD = "flame2023"
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
    head = find_head(path.parent, declaration, None) if declaration else request.head(TRACKED_HEAD)
    if path.is_dir():
        files, timing = in_order([*path.glob("*.npz")])
        if not files:
            raise InputError(path, "", "a .npz file of parameters for each frame", "none")
        tracking = read_tracking(dict(enumerate(files)), head, "")
    else:
        tracking = read_animation(path, head)
        timing = request.columns.timing
    poses = [tracking.poses[timestep] for timestep in sorted(tracking.poses)]
    unused = {**IDENTITY_UNUSED, **{k: v for k, v in tracking.notes.items() if k == "eyelids"}}
    if tracking.notes.get("dynamic_offset_ignored_m"):
        unused["dynamic_offset"] = "offsets of vertices"
    return DrivingSignal("flame_param", tracking.head, poses, timing, unused)


def read_capture_signal(request: SignalRequest) -> DrivingSignal:
    """Poses of one sequence of a capture of any layout, without excluded frames, in the order of time."""
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
    poses = [clip.poses[t] for t in timesteps]
    return DrivingSignal("capture", clip.head, poses, Timing.of_numbers(timesteps), IDENTITY_UNUSED)


DEFAULT_HEAD = "flame2020"
"""Head model of all five."""


def is_coefficients(table: SignalTable) -> bool:
    """Whether a table has expression coefficients under a known name."""
    return any(name in table.columns for name in NAMES["expression"])


def read_coefficients(request: SignalRequest) -> DrivingSignal:
    """Coefficients of each frame with a face. Identity is ignored."""
    table = request.columns
    head = request.head(DEFAULT_HEAD)
    column_of = {part: next((n for n in names if n in table.columns), "") for part, names in NAMES.items()}
    table = table.with_face([name for name in column_of.values() if name])
    if not column_of["expression"]:
        expected = f"expression coefficients: {', '.join(NAMES['expression'])}"
        raise InputError(table.path, "", expected, ", ".join(sorted(table.columns)))
    values = {part: table.values(name) for part, name in column_of.items() if name}
    parts = _parts(table, values, column_of)
    taken = {part: name for part, name in column_of.items() if name and _drives(part, parts, values)}
    used = {*taken.values()}
    unused = {
        name: "identity" if name in IDENTITY else "no coefficient of the pose"
        for name in table.columns
        if name not in (*used, table.timing.column)
    }
    if "eyelids" in parts and head.eyelid_basis is None:
        unused[column_of["eyelids"]] = NO_EYELIDS
    return DrivingSignal("coefficients", head, make_poses(table.path, head, parts), table.timing, unused)


def _parts(
    table: SignalTable, values: Mapping[str, FloatArray], names: Mapping[str, str]
) -> dict[str, FloatArray]:
    """The parts of poses, those of `NAMES` that hold several or half of one split and joined."""
    parts = {name: array for name, array in values.items() if name not in ("pose", "left_eye", "right_eye")}
    if "pose" in values:
        pose = values["pose"]
        if pose.shape[1] not in (3, 6):
            expected = "6 numbers a frame, rotation and jaw, or 3, rotation"
            raise InputError(table.path, names["pose"], expected, str(pose.shape[1]))
        parts.setdefault("rotation", pose[:, :3])
        if pose.shape[1] == 6:
            parts.setdefault("jaw", pose[:, 3:])
    sides = [values[side] for side in ("left_eye", "right_eye") if side in values]
    if len(sides) == 2:
        parts.setdefault("eyes", np.concatenate(sides, axis=1))
    return parts


def _drives(part: str, parts: Mapping[str, FloatArray], values: Mapping[str, FloatArray]) -> bool:
    """Whether an array of the signal is in the parts of the poses: ``pose`` and single eyes may be superseded or incomplete."""
    if part == "pose":
        return "rotation" not in values or ("jaw" not in values and values[part].shape[1] == 6)
    if part in ("left_eye", "right_eye"):
        return "eyes" not in values and "eyes" in parts
    return True


_COMPONENT = re.compile(r"([a-z]+)\.(\d+)")


def read_mapped(request: SignalRequest) -> DrivingSignal:
    """Poses of a table by the map file of the request, ``{column: {coefficient: weight}}``."""
    table, source = request.columns, Path(request.map)
    content = {str(name): entry for name, entry in read_yaml(source).items()}
    weights = checked(content, dict[str, dict[str, float]], source)
    for column, entry in weights.items() or (("", {}),):
        if not entry:
            raise InputError(source, column, "{column: {coefficient: weight}}", "an empty map")
        if column not in table.columns:
            raise unknown(str(source), "columns", column, [*table.columns])
    table = table.with_face([*weights])
    without = (*weights, table.timing.column)
    unused = dict.fromkeys((name for name in table.columns if name not in without), "not in the map")
    values = {column: table.single(column) for column in weights}
    targets = {name for entry in weights.values() for name in entry}
    blendshapes = targets & {*ARKIT}
    if blendshapes and blendshapes != targets:
        other = min(targets - blendshapes)
        raise InputError(source, other, "names of blendshapes alone, or coefficients alone", "both")
    sums: dict[str, FloatArray] = {name: np.zeros(len(table)) for name in sorted(targets)}
    for column, entry in weights.items():
        for name, weight in entry.items():
            sums[name] += weight * values[column]
    if blendshapes:
        signal = apply_blendshapes(request, sums, table.timing)
        return replace(signal, form="mapped", unused={**unused, **signal.unused})
    head = request.head()
    poses = make_poses(table.path, head, _coefficients(source, head, sums))
    return DrivingSignal("mapped", head, poses, table.timing, unused)


def _coefficients(source: Path, head: HeadArrays, sums: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """(T, n) parts of poses from (T,) values by the name of a coefficient or of an expression of the head."""
    length = len(next(iter(sums.values())))
    lids = {} if head.eyelid_basis is None else {"eyelids": head.eyelid_basis.shape[2]}
    sizes = {"expression": head.expression_basis.shape[2], **POSE_PARTS, **lids}
    named = {shape.name: shape.direction for shape in head.named_expressions()}
    named |= dict(zip(head.expression_names, np.eye(sizes["expression"])))
    parts = {name: np.zeros((length, size)) for name, size in sizes.items()}
    for name, values in sums.items():
        match = _COMPONENT.fullmatch(name)
        if name in named:
            parts["expression"] += values[:, None] * named[name]
        elif match and int(match[2]) < sizes.get(match[1], 0):
            parts[match[1]][:, int(match[2])] += values
        else:
            coefficients = [f"{part}.{n}" for part, size in sizes.items() for n in range(size)]
            raise unknown(str(source), "coefficients", name, [*named, *coefficients])
    return parts


@dataclass(frozen=True)
class SignalFormat:
    """A format of driving signals."""

    name: str
    summary: str
    """Name for ``--form``, and a description."""
    fits: Callable[[SignalTable], bool]
    """Whether a table without a map is of this format."""
    read: Callable[[SignalRequest], DrivingSignal]
    """Reader; its errors are `InputError`."""


FORMATS = (
    SignalFormat(
        "flame_param",
        "FLAME parameters of VHAP, by frame or in one npz",
        is_flame_parameters,
        read_flame_parameters,
    ),
    SignalFormat(
        "coefficients",
        "FLAME coefficients of DECA, EMOCA, INFERNO, SMIRK, SHeaP",
        is_coefficients,
        read_coefficients,
    ),
    SignalFormat(
        "blendshapes", "52 blendshapes of ARKit, MediaPipe, Audio2Face", is_blendshapes, read_blendshapes
    ),
    SignalFormat(
        "capture", "a capture in a layout that a reader knows", lambda table: False, read_capture_signal
    ),
    SignalFormat("mapped", "a table of numbers with --map", lambda table: False, read_mapped),
)
"""In the order in which they are tried. A folder that a reader of captures finds is a capture, a table with a map is mapped."""
_BY_NAME = {form.name: form for form in FORMATS}


def read_signal(request: SignalRequest, name: str = "") -> DrivingSignal:
    """Read a signal in the named format, or in the one that recognises it."""
    if name and name not in _BY_NAME:
        raise unknown("command line", "--form", name, [*_BY_NAME])
    path = request.path
    if not path.exists():
        raise InputError(path, "", "a signal", "no such file or folder")
    specs = readers().values() if path.is_dir() else ()
    if name == "capture" or (not name and not request.map and any(finds(spec, path) for spec in specs)):
        return read_capture_signal(request)
    if request.sequence:
        raise InputError("command line", "--sequence", "a signal that is a capture", str(path))
    return read_rows(replace(request, table=read_table(path, request.fps)), name)


def read_rows(request: SignalRequest, name: str = "") -> DrivingSignal:
    """Read the signal of a request with a table, as `read_signal` does."""
    if request.map or name == "mapped":
        if not request.map or name not in ("", "mapped"):
            expected = "--form mapped" if request.map else "the map of --form mapped"
            raise InputError("command line", "--map", expected, f"--form {name}")
        return read_mapped(request)
    fitting = [form for form in FORMATS if form.fits(request.columns)]
    if not name and not fitting:
        expected = "; ".join(f"{form.name}: {form.summary}" for form in FORMATS)
        found = ", ".join([*request.columns.columns][:12])
        raise InputError(
            request.path, "columns", expected, found, "Name other columns in a map file: --map FILE.yaml."
        )
    return (_BY_NAME[name] if name else fitting[0]).read(request)
