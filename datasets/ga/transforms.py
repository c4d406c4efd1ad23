"""Read a transforms JSON into validated frame entries; errors name file and frame.

Formats read:

- Transforms JSON of GaussianAvatars. Written by ShenhanQian/VHAP@4b64ab7d (`vhap/export_as_nerf_dataset.py`,
  `vhap/combine_nerf_datasets.py`). Not checked on a file of the program.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any, Literal, NamedTuple

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.documents import read_json
from ...bench.io.files import check_name, with_slashes
from ..open import IMAGES, frame_route
from .layout import TRACKING_FOLDER

INTRINSIC_KEYS = ("cx", "cy", "fl_x", "fl_y", "camera_angle_x")
RIGID_TOLERANCE = 1e-4
MAX_INTEGER = 2**31
_IDENTITY, _LAST_ROW = np.eye(3), np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class FrameEntry:
    """One frame of a transforms JSON with resolved paths and checked types.

    ``where`` is the JSON's path to the entry ("frames[17]"), for error messages. ``sequence_folder`` is the name of the
    folder that holds the parameters' folder, however the JSON leads there. ``intrinsics`` has those of `INTRINSIC_KEYS`
    that the frame or the document states. ``width`` and ``height`` are None if the JSON does not state them.
    """

    file: Path
    where: str
    timestep: int
    camera_index: int
    camera_id: str
    sequence_folder: str
    image: Path
    mask: Path | None
    parameters: Path
    width: int | None
    height: int | None
    intrinsics: Mapping[str, float]
    camera_to_world: FloatArray  # (4, 4), OpenGL axes


FaultKind = Literal["declaration", "json", "frame", "file", "head", "parameters", "check"]
"""The content that could not be read, or "check" of content that was read."""


class Fault(NamedTuple):
    """An error of reading a capture."""

    kind: FaultKind
    error: InputError
    content: Any
    """Of a frame, its JSON object; otherwise None."""


class Faults(list[Fault]):
    """Errors of reading a capture: the first is raised, or with ``collect`` all are kept and reading continues."""

    def __init__(self, collect: bool = False) -> None:
        self._collect = collect

    @contextmanager
    def of(self, kind: FaultKind, content: Any = None) -> Iterator[None]:
        """Raise or keep an `InputError` of the block."""
        try:
            yield
        except InputError as error:
            if not self._collect:
                raise
            self.append(Fault(kind, error, content))

    def errors(self, *kinds: FaultKind) -> list[InputError]:
        """Errors of these kinds, in the order of reading."""
        return [fault.error for fault in self if fault.kind in kinds]


RAISED = Faults()
"""Raises the first error."""


def read_transforms(path: Path, faults: Faults = RAISED) -> list[FrameEntry]:
    """Read and check the frames of a transforms JSON. Faults are invalid JSON, missing keys, values of the wrong type
    or range, and matrices that are not rigid motions."""
    entries: list[FrameEntry] = []
    with faults.of("json"):
        document = read_json(path)
        frames = document.get("frames")
        if not isinstance(frames, list):
            raise InputError(path, "frames", "a list of frames", found_entry(frames))
        with faults.of("check"):
            check_lenses(path, document)
        for index, frame in enumerate(frames):
            with faults.of("frame", frame):
                entries.append(parse_frame(path, f"frames[{index}]", frame, document))
    return entries


def check_lenses(path: Path, document: Mapping[str, Any]) -> None:
    """Raise `InputError` if a transforms JSON has lenses other than pinholes, by the keys of nerfstudio. Renders have
    no distortion and cannot be compared with distorted images."""
    frames = document.get("frames")
    parts = [("", document)]
    parts += (
        [(f"frames[{i}].", f) for i, f in enumerate(frames) if isinstance(f, dict)]
        if isinstance(frames, list)
        else []
    )
    for where, part in parts:
        for key in [key for key in part if key.lower() in LENS_KEYS]:
            value = part[key]
            if key == "camera_model":
                fits = str(value).upper() in PINHOLES
            else:
                values = value if isinstance(value, list) else [value]
                fits = all(v is None or (isinstance(v, (int, float)) and v == 0) for v in values)
            if not fits:
                expected = (
                    f"one of {', '.join(PINHOLES)}"
                    if key == "camera_model"
                    else "0, images without distortion"
                )
                raise InputError(path, f"{where}{key}", expected, found_entry(value), UNDISTORT)


LENS_KEYS = {
    *("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "distortion_params", "is_fisheye", "camera_model"),
    *("distortion", "distortion_coefficients", "distortion_coeffs", "dist_coeffs", "skew"),
}
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL", "FULL_OPENCV", "PERSPECTIVE")
"""Camera models that are pinholes if their distortion coefficients are 0."""
UNDISTORT = (
    "Undistort the images and state their pinhole camera (`colmap image_undistorter`); the reader colmap "
    "removes distortion itself."
)


def parse_frame(path: Path, where: str, frame: Any, document: Mapping[str, Any]) -> FrameEntry:
    """Read and check one frame of the document at ``path``; see `read_transforms`. ``where``: JSON path of the frame,
    for messages. ``document``: The whole document, which may state intrinsics for all frames."""
    if not isinstance(frame, dict):
        raise InputError(path, where, "an object", type(frame).__name__)
    reader = _FrameReader(path, where, frame, document)
    way = frame_route(frame)
    if way:
        raise InputError(path, f"{where}.flame_param_path", "text", "no such key", way)
    image = reader.path("file_path")
    if image.suffix.lower() not in IMAGES:
        image = Path(f"{image}.png")  # as GaussianAvatars does
    parameters = reader.path("flame_param_path")
    camera_index = reader.integer("camera_index") if reader.has("camera_index") else 0
    intrinsics = {key: reader.number(key) for key in INTRINSIC_KEYS if reader.has(key)}
    _check_intrinsics(path, where, intrinsics)
    return FrameEntry(
        file=path,
        where=where,
        timestep=reader.integer("timestep_index"),
        camera_index=camera_index,
        camera_id=reader.name("camera_id") if reader.has("camera_id") else f"{camera_index:02d}",
        sequence_folder=check_name(
            _sequence_folder(path.parent, image, parameters), path, f"{where}.flame_param_path"
        ),
        image=image,
        mask=reader.path("fg_mask_path") if reader.has("fg_mask_path") else None,
        parameters=parameters,
        width=reader.integer("w") if reader.has("w") else None,
        height=reader.integer("h") if reader.has("h") else None,
        intrinsics=intrinsics,
        camera_to_world=read_rigid(path, f"{where}.transform_matrix", frame.get("transform_matrix")),
    )


def _check_intrinsics(path: Path, where: str, intrinsics: Mapping[str, float]) -> None:
    if "fl_x" not in intrinsics and "camera_angle_x" not in intrinsics:
        raise InputError(path, where, "fl_x or camera_angle_x", "neither")
    for key in ("fl_x", "fl_y"):
        if intrinsics.get(key, 1.0) <= 0:
            expected = "a positive focal length in pixels"
            raise InputError(path, f"{where}.{key}", expected, f"{intrinsics[key]}")
    angle = intrinsics.get("camera_angle_x", 1.0)
    if not 0 < angle < np.pi:
        raise InputError(path, f"{where}.camera_angle_x", "an angle in (0, pi) radians", f"{angle}")


def _sequence_folder(folder: Path, image: Path, parameters: Path) -> str:
    """Name of the folder of the sequence's files: of ``flame_param``, else of ``images``, else the innermost of both files."""
    folder, image, parameters = (Path(os.path.abspath(path)) for path in (folder, image, parameters))
    for file, usual in ((parameters, TRACKING_FOLDER), (image, "images")):
        if file.parent.name == usual:
            return file.parent.parent.name
    shared = Path(os.path.commonpath([image, parameters]))
    return folder.name if folder.is_relative_to(shared) else shared.name


class _FrameReader:
    """Typed access to one frame; intrinsics and size may be at the document's top level instead."""

    def __init__(self, path: Path, where: str, frame: Mapping[str, Any], document: Mapping[str, Any]):
        self._path, self._where, self._frame, self._document = path, where, frame, document

    def has(self, key: str) -> bool:
        return self._get(key) is not None

    def _fail(self, key: str, expected: str) -> InputError:
        return InputError(self._path, f"{self._where}.{key}", expected, found_entry(self._get(key)))

    def _get(self, key: str) -> Any:
        value = self._frame.get(key)
        return self._document.get(key) if value is None else value

    def text(self, key: str) -> str:
        value = self._frame.get(key)
        if not isinstance(value, str) or not value:
            raise self._fail(key, "text")
        return value

    def path(self, key: str) -> Path:
        text = self.text(key)
        root = "/" if PureWindowsPath(text).drive else ""  # C:/images is absolute here, too
        return self._path.parent / (root + with_slashes(text))

    def name(self, key: str) -> str:
        """Text, or a whole number in place of it."""
        value = self._get(key)
        text = value if isinstance(value, str) and value else str(self.integer(key))
        return check_name(text, self._path, f"{self._where}.{key}")

    def integer(self, key: str) -> int:
        value = _number(self._get(key))
        if not (value.is_integer() and 0 <= value < MAX_INTEGER):
            raise self._fail(key, f"an integer from 0 to {MAX_INTEGER - 1}")
        return int(value)

    def number(self, key: str) -> float:
        value = _number(self._get(key))
        if not math.isfinite(value):
            raise self._fail(key, "a finite number")
        return value


def _number(value: Any) -> float:
    """A JSON number; NaN for anything else."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        with suppress(OverflowError):  # JSON integers have no bound
            return float(value)
    return math.nan


def read_matrix(file: Path, key: str, value: Any, size: int) -> FloatArray:
    """(size, size) matrix of a JSON."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise InputError(file, key, f"a {size}x{size} matrix of finite numbers", found_entry(value))
    return matrix


def read_rigid(file: Path, key: str, value: Any) -> FloatArray:
    """(4, 4) rigid motion of a JSON."""
    matrix = read_matrix(file, key, value, 4)
    rotation = matrix[:3, :3]
    skew = np.abs(rotation @ rotation.T - _IDENTITY).max()
    projective = np.abs(matrix[3] - _LAST_ROW).max()
    if max(skew, projective) > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        expected = "a rigid motion (orthonormal, right-handed, last row 0 0 0 1)"
        raise InputError(file, key, expected, found_entry(value))
    return matrix


def found_entry(value: Any) -> str:
    """Representation of a JSON entry in an error; None for a missing one."""
    return "no such key" if value is None else repr(value)[:60]


def timesteps_of(entries: Sequence[FrameEntry]) -> list[int]:
    """Distinct timesteps, sorted."""
    return sorted({entry.timestep for entry in entries})
