"""FLAME coefficients as trackers of single images give them: DECA, EMOCA, SMIRK and SHeaP.

They have no file format for videos; arrays of their outputs are read under the names in `NAMES`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from .names import IDENTITY, NAMES
from .signal import NO_EYELIDS, DrivingSignal, SignalRequest, make_poses
from .table import SignalTable

DEFAULT_HEAD = "flame2020"
"""Head model of all four."""


def is_coefficients(table: SignalTable) -> bool:
    """Whether a table has expression coefficients under a known name."""
    return any(name in table.columns for name in NAMES["expression"])


def read_coefficients(request: SignalRequest) -> DrivingSignal:
    """Coefficients of each frame. Identity is ignored."""
    table = request.columns
    head = request.head(DEFAULT_HEAD)
    found = {part: next((n for n in names if n in table.columns), "") for part, names in NAMES.items()}
    if not found["expression"]:
        expected = f"expression coefficients: {', '.join(NAMES['expression'])}"
        raise InputError(table.path, "", expected, ", ".join(sorted(table.columns)))
    values = {part: table.values(name) for part, name in found.items() if name}
    parts = _parts(table, values, found)
    taken = {part: name for part, name in found.items() if name and _drives(part, parts, values)}
    used = {*taken.values()}
    unused = {
        name: "identity" if name in IDENTITY else "no coefficient of the pose"
        for name in table.columns
        if name not in used
    }
    if "eyelids" in parts and head.eyelid_basis is None:
        unused[found["eyelids"]] = NO_EYELIDS
    return DrivingSignal("coefficients", head, make_poses(table.path, head, parts), unused)


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
