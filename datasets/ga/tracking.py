"""Head model and tracked parameters of a capture: ``flame_param`` files to poses, identity and static offset.

Formats read:

- FLAME parameters of GaussianAvatars, `flame_param/*.npz` and `flame_param.npz`. Written by
  ShenhanQian/VHAP@4b64ab7d (`vhap/export_as_nerf_dataset.py`) and by ShenhanQian/GaussianAvatars@30cc4bde
  (`scene/flame_gaussian_model.py`). Not checked on a file of the program.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...bench.contracts import FloatArray, HeadPose
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, check_numbers, read_npz
from ..head.arrays import HeadArrays, check_size
from ..head.loaders import EYELIDS_REMEDY, OPEN, load_head
from ..head.teeth import with_teeth, with_teeth_where_possible
from .layout import DECLARATION_FILE, HEAD_FILE, Declaration

log = logging.getLogger(__name__)


def find_head(
    folder: Path,
    declaration: Declaration | None,
    head: HeadArrays | str | Path | None,
    **files: str | Path | None,
) -> HeadArrays:
    """Head model of a capture, of the declared version.

    ``head``: The head model or its file; None takes the file that ``headbench.json`` names, else the capture's
    ``head_model.npz``. ``files``: Arguments masks, regions and eyelids of `load_head`, which finds them by itself beside a
    FLAME pickle.
    """
    asset = read_head_model(folder, declaration, head, **files)
    check_version(folder, declaration, asset)
    return asset


def read_head_model(
    folder: Path,
    declaration: Declaration | None,
    head: HeadArrays | str | Path | None,
    **files: str | Path | None,
) -> HeadArrays:
    """Head model of a capture, of any version; arguments as of `find_head`."""
    if isinstance(head, HeadArrays):
        return head
    path = Path(head) if head else folder / (declaration.head_file if declaration else HEAD_FILE)
    asset = _load(path, files)
    if asset.version == OPEN and not declaration:
        log.warning(
            "%s is FLAME 2023 Open. Its coefficients are not those of FLAME 2023, and %s does not say which of them "
            "it was tracked with: `headbench prepare refit` converts a capture of FLAME 2023.",
            path,
            folder,
        )
    return asset


def check_version(folder: Path, declaration: Declaration | None, head: HeadArrays) -> None:
    """Check that a head model has the declared version."""
    if declaration and head.version != declaration.head_model:
        expected = f"{head.version}, the version of the head model given"
        remedy = "Coefficients of different head models are not interchangeable."
        raise InputError(folder / DECLARATION_FILE, "head_model", expected, declaration.head_model, remedy)


def _load(path: Path, files: Mapping[str, Any]) -> HeadArrays:
    if not path.exists():
        remedy = (
            "Captures of NeRSemble subjects need flame2023.pkl (FLAME 2023 with jaw rotation, not FLAME 2023 Open) from "
            "https://flame.is.tue.mpg.de; give its path as head=. Synthetic captures contain theirs."
        )
        raise InputError(path, "", "the head model the capture was tracked with", "no such file", remedy)
    return load_head(path, **files)


TeethPolicy = Literal["auto", "add", "keep"]

POSE_SIZES = {"translation": 3, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6}
"""Arrays of a parameter file and their numbers per timestep, in the order of VHAP's export."""


def pose_to_parameters(pose: HeadPose) -> dict[str, FloatArray]:
    """Per-timestep part of a ``flame_param`` file, float32; the additional ``eyelids`` only if the pose has them."""
    parameters = {
        "translation": pose.translation,
        "rotation": pose.rotation,
        "neck_pose": pose.neck,
        "jaw_pose": pose.jaw,
        "eyes_pose": pose.eyes,
        "expr": pose.expression,
    }
    if pose.eyelids is not None:
        parameters["eyelids"] = pose.eyelids
    return {key: np.asarray(value, dtype=np.float32)[None] for key, value in parameters.items()}


@dataclass(frozen=True, eq=False)
class Tracking:
    """Content of the parameter files, and the head that they belong to (with teeth appended if needed). ``notes``
    records decisions about properties that the layout does not define."""

    head: HeadArrays
    poses: Mapping[int, HeadPose]
    shape: FloatArray  # (S,)
    static_offset: FloatArray  # (V, 3)
    notes: Mapping[str, Any] = field(default_factory=dict)


def read_tracking(
    files: Mapping[int, Path], head: HeadArrays, subject: str, *, teeth: TeethPolicy = "auto"
) -> Tracking:
    """Read and check the parameter file of every timestep.

    Identity and static offset are those of the first timestep, as in GaussianAvatars; differences of later ones are
    noted. ``dynamic_offset`` is ignored, and noted if it is not zero. Coefficient vectors shorter than the head's
    bases are padded with zeros.

    ``teeth``: "auto" appends teeth (see `with_teeth`) to every head without them, as GaussianAvatars does to FLAME, so that
    all methods have the same; a head without lip rings stays without teeth, unless it is FLAME's or the static offset has
    rows for them. "add" always appends them; "keep" does not change the head.
    """
    reading = TrackingReading(head, subject, teeth)
    for timestep, path in sorted(files.items()):
        reading.add(timestep, path, read_npz(path))
    return reading.tracking()


class TrackingReading:
    """Parameters of timesteps that are added one after the other; see `read_tracking`. Identity, teeth and static
    offset are those of the first file that is accepted."""

    def __init__(self, head: HeadArrays, subject: str, teeth: TeethPolicy = "auto") -> None:
        self.head, self._subject, self._teeth = head, subject, teeth
        self.poses: dict[int, HeadPose] = {}
        self._files: list[Path] = []
        self._closed = 0.0
        self._change = {"shape": 0.0, "static_offset_m": 0.0, "dynamic_offset_m": 0.0}

    def add(
        self, timestep: int, path: Path, arrays: Mapping[str, np.ndarray]
    ) -> tuple[FloatArray, FloatArray]:
        """Check the arrays of a file and add its pose; returns its shape, (S,), and static offset, (V, 3).

        Arrays with an error are not added, except that the pose is if only the static offset has other rows than the
        first file's.
        """
        shape = _vector(path, arrays, "shape", self.head.shape_basis.shape[2])
        offset = _offset(path, arrays, "static_offset")
        teeth: TeethPolicy = "keep" if self.poses else self._teeth
        head, rows = resolve_teeth(self.head, len(offset) if offset is not None else None, teeth, path)
        static_offset = np.zeros((len(head.template), 3), dtype=np.float32)
        if offset is not None:
            static_offset[:rows] = offset[:rows]
        dynamic = _largest(_offset(path, arrays, "dynamic_offset"))
        closed = _largest(_array(path, arrays, "eyelids")) if "eyelids" in arrays else 0.0
        pose = _pose(path, arrays, head, self._subject, timestep)
        if not self.poses:
            check_neutral(path, head, shape, static_offset)
            self.head, self.shape, self.static_offset, self._offset = head, shape, static_offset, offset
        self.poses[timestep] = pose
        self._files.append(path)
        self._closed = max(self._closed, closed)
        static = _offset_change(path, offset, self._offset)
        for key, change in zip(self._change, (_largest(shape - self.shape), static, dynamic)):
            self._change[key] = max(self._change[key], change)
        return shape, static_offset

    def tracking(self) -> Tracking:
        """All poses and their identity."""
        rows = f"{len(self._offset)} rows" if self._offset is not None else "zeros, as the files have none"
        notes = {
            "static_offset": rows,
            "teeth": len(self.head.regions.get("teeth", ())),
            "change_of_shape_ignored": self._change["shape"],
            "change_of_static_offset_ignored_m": self._change["static_offset_m"],
            "dynamic_offset_ignored_m": self._change["dynamic_offset_m"],
        }
        notes |= _eyelids(min(self._files).parent, self.head, self._closed)
        return Tracking(self.head, self.poses, self.shape, self.static_offset, notes)


def read_animation(
    path: Path, head: HeadArrays, subject: str = "", *, teeth: TeethPolicy = "auto"
) -> Tracking:
    """Read and check one file with the parameters of all timesteps, as GaussianAvatars stores it beside its splats.

    Like a parameter file of `read_tracking`, with a row of each pose array for every timestep, whose number is the
    timestep. A file of one timestep has one row. Errors are those of `read_tracking`.
    """
    arrays = read_npz(path)
    identity = _vector(path, arrays, "shape", head.shape_basis.shape[2])
    static = _offset(path, arrays, "static_offset")
    head, rows = resolve_teeth(head, len(static) if static is not None else None, teeth, path)
    moving = [*POSE_SIZES, "expr"]
    moving += ["eyelids"] if head.eyelid_basis is not None and "eyelids" in arrays else []
    table = {key: np.atleast_2d(_array(path, arrays, key)) for key in moving}
    length = len(table["expr"])
    for key, values in table.items():
        if values.ndim != 2 or len(values) != length or not length:
            expected = f"a row for each of the {length} timesteps of expr" if length else "a timestep or more"
            raise InputError(path, key, expected, f"shape {arrays[key].shape}")
    poses = {
        row: _pose(path, {key: values[row : row + 1] for key, values in table.items()}, head, subject, row)
        for row in range(length)
    }
    static_offset = np.zeros((len(head.template), 3), dtype=np.float32)
    if static is not None:
        static_offset[:rows] = static[:rows]
    check_neutral(path, head, identity, static_offset)
    dynamic = _array(path, arrays, "dynamic_offset") if "dynamic_offset" in arrays else None
    closed = _largest(_array(path, arrays, "eyelids")) if "eyelids" in arrays else 0.0
    notes = {"dynamic_offset_ignored_m": _largest(dynamic), **_eyelids(path, head, closed)}
    return Tracking(head, poses, identity, static_offset, notes)


def _eyelids(where: Path, head: HeadArrays, closed: float) -> dict[str, str]:
    """Note on eyelids that are closed by up to ``closed`` in the files, with a warning if they are lost."""
    if not closed:
        return {}
    note = f"closed by up to {closed:.2f}"
    if head.eyelid_basis is None:
        note += ", left out: the head model has no basis"
        log.warning("%s: eyelids: %s. %s", where, note, EYELIDS_REMEDY)
    return {"eyelids": note}


def resolve_teeth(
    head: HeadArrays, rows: int | None, teeth: TeethPolicy, file: Path
) -> tuple[HeadArrays, int]:
    """Match head and static offset: returns the head to use, and the number of rows of the offset to use. ``rows`` is
    the number of rows of the files' static offset, None without one."""
    vertices = len(head.template)
    if teeth != "keep" and not len(head.regions.get("teeth", ())):
        required = teeth == "add" or head.version.startswith("flame") or (rows or 0) > vertices
        head = with_teeth(head) if required else with_teeth_where_possible(head)
    has_teeth = len(head.regions.get("teeth", ())) > 0
    total = len(head.template)
    if rows is None or rows == total:
        return head, total
    if teeth == "keep" and rows > total:
        return head, total
    last = np.arange(rows, total)
    if rows < total and has_teeth and np.isin(last, head.regions["teeth"]).all():
        return head, rows
    expected = f"(1, {total}, 3) for head model {head.version}"
    found = f"{rows} rows"
    remedy = "Give the head model the capture was tracked with."
    raise InputError(file, "static_offset", expected, found, remedy)


def check_neutral(file: Path, head: HeadArrays, shape: FloatArray, static_offset: FloatArray) -> None:
    """Raise `InputError` if the identity gives a mesh with a size impossible for a head."""
    neutral = head.template + head.shape_basis @ shape + static_offset
    check_size(file, "shape, static_offset", neutral, head.faces)


def _pose(
    path: Path, arrays: Mapping[str, np.ndarray], head: HeadArrays, subject: str, timestep: int
) -> HeadPose:
    parts = {key: _row(path, arrays, key, size) for key, size in POSE_SIZES.items()}
    eyelids = None
    if head.eyelid_basis is not None and "eyelids" in arrays:
        eyelids = _row(path, arrays, "eyelids", head.eyelid_basis.shape[2])
    return HeadPose(
        head_model=head.version,
        expression=_vector(path, arrays, "expr", head.expression_basis.shape[2]),
        rotation=parts["rotation"],
        neck=parts["neck_pose"],
        jaw=parts["jaw_pose"],
        eyes=parts["eyes_pose"],
        translation=parts["translation"],
        eyelids=eyelids,
        subject=subject,
        timestep=timestep,
    )


def _array(path: Path, arrays: Mapping[str, np.ndarray], key: str) -> FloatArray:
    if key not in arrays:
        raise InputError(path, key, "an array", f"only {', '.join(sorted(arrays))}")
    array = arrays[key]
    if array.dtype.kind not in "fiu":
        raise InputError(path, key, "numbers", f"dtype {array.dtype}")
    check_numbers(path, key, array, MAX_MAGNITUDE)
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def _row(path: Path, arrays: Mapping[str, np.ndarray], key: str, size: int) -> FloatArray:
    """A (1, size) or (size,) array as (size,)."""
    array = _array(path, arrays, key)
    if array.shape not in ((1, size), (size,)):
        raise InputError(path, key, f"shape (1, {size})", f"shape {array.shape}")
    return array.reshape(size)


def _vector(path: Path, arrays: Mapping[str, np.ndarray], key: str, size: int) -> FloatArray:
    """Coefficients, (n,) or (1, n) with n up to ``size``, zero-padded to (size,)."""
    array = _array(path, arrays, key)
    fits = array.ndim == 1 or (array.ndim == 2 and array.shape[0] == 1)
    if not fits or array.size > size:
        remedy = "Give the head model the capture was tracked with."
        raise InputError(path, key, f"at most {size} coefficients in one row", f"shape {array.shape}", remedy)
    return np.pad(array.reshape(-1), (0, size - array.size))


def _offset(path: Path, arrays: Mapping[str, np.ndarray], key: str) -> FloatArray | None:
    """A (1, n, 3) or (n, 3) array as (n, 3); None if the file has none."""
    if key not in arrays:
        return None
    array = _array(path, arrays, key)
    shape = array.shape[1:] if array.ndim == 3 and array.shape[0] == 1 else array.shape
    if len(shape) != 2 or shape[1] != 3:
        raise InputError(path, key, "shape (1, V, 3)", f"shape {array.shape}")
    return array.reshape(shape)


def _offset_change(path: Path, offset: FloatArray | None, first: FloatArray | None) -> float:
    """Largest change of the static offset relative to the first timestep, metres."""
    if offset is None or first is None or offset.shape != first.shape:
        if offset is None and first is None:
            return 0.0
        expected = "none" if first is None else f"{len(first)} rows, as at the first timestep"
        raise InputError(path, "static_offset", expected, "none" if offset is None else f"{len(offset)} rows")
    return _largest(offset - first)


def _largest(values: FloatArray | None) -> float:
    return float(np.abs(values).max(initial=0.0)) if values is not None else 0.0
