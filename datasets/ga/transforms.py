"""Read a transforms JSON into validated frame entries; errors name file and frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.documents import read_json
from ...bench.io.files import check_name, with_slashes
from ..foreign import IMAGES, frame_route

INTRINSIC_KEYS = ("cx", "cy", "fl_x", "fl_y", "camera_angle_x")
RIGID_TOLERANCE = 1e-4
MAX_INTEGER = 2**31
_IDENTITY, _LAST_ROW = np.eye(3), np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class FrameEntry:
    """One frame of a transforms JSON with resolved paths and checked types.

    ``where`` is the JSON's path to the entry ("frames[17]"), for error messages. ``intrinsics`` has those of
    `INTRINSIC_KEYS` that the frame or the document states. ``width`` and ``height`` are None if the JSON does not
    state them.
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


def read_transforms(path: Path) -> list[FrameEntry]:
    """Read and check the frames of a transforms JSON.

    Raises `InputError` for invalid JSON, missing keys, values of the wrong type or range, and matrices that are not
    rigid motions.
    """
    document = read_json(path)
    frames = document.get("frames")
    if not isinstance(frames, list):
        raise InputError(path, "frames", "a list of frames", found_entry(frames))
    check_lenses(path, document)
    return [parse_frame(path, f"frames[{i}]", frame, document) for i, frame in enumerate(frames)]


def check_lenses(path: Path, document: Mapping[str, Any]) -> None:
    """Raise `InputError` if a transforms JSON has lenses other than pinholes, by the keys of nerfstudio.

    Renders have no distortion and cannot be compared with distorted images.
    """
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
    """Read and check one frame of the document at ``path``; see `read_transforms`.

    Parameters
    ----------
    where : str
        JSON path of the frame, for messages.
    document : Mapping[str, Any]
        The whole document, which may state intrinsics for all frames.
    """
    if not isinstance(frame, dict):
        raise InputError(path, where, "an object", type(frame).__name__)
    reader = _FrameReader(path, where, frame, document)
    way = frame_route(frame)
    if way:
        raise InputError(path, f"{where}.flame_param_path", "text", "no such key", way)
    image = with_slashes(reader.text("file_path"))
    if Path(image).suffix.lower() not in IMAGES:
        image += ".png"  # as GaussianAvatars does
    mask = with_slashes(reader.text("fg_mask_path")) if "fg_mask_path" in frame else None
    camera_index = reader.integer("camera_index") if "camera_index" in frame else 0
    intrinsics = {key: reader.number(key) for key in INTRINSIC_KEYS if reader.has(key)}
    _check_intrinsics(path, where, intrinsics)
    return FrameEntry(
        file=path,
        where=where,
        timestep=reader.integer("timestep_index"),
        camera_index=camera_index,
        camera_id=reader.name("camera_id") if "camera_id" in frame else f"{camera_index:02d}",
        sequence_folder=check_name(_sequence_folder(path.parent, image), path, f"{where}.file_path"),
        image=path.parent / image,
        mask=path.parent / mask if mask else None,
        parameters=path.parent / with_slashes(reader.text("flame_param_path")),
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


def _sequence_folder(folder: Path, image: str) -> str:
    """Folder of ``images/``: the sequence's own, also if a union refers to it."""
    parts = Path(image).parts
    return parts[1] if len(parts) > 2 and parts[0] == ".." else folder.name


class _FrameReader:
    """Typed access to one frame; intrinsics and size may be at the document's top level instead."""

    def __init__(self, path: Path, where: str, frame: Mapping[str, Any], document: Mapping[str, Any]):
        self._path, self._where, self._frame, self._document = path, where, frame, document

    def has(self, key: str) -> bool:
        return key in self._frame or key in self._document

    def _fail(self, key: str, expected: str) -> InputError:
        return InputError(self._path, f"{self._where}.{key}", expected, found_entry(self._get(key)))

    def _get(self, key: str) -> Any:
        return self._frame.get(key, self._document.get(key))

    def text(self, key: str) -> str:
        value = self._frame.get(key)
        if not isinstance(value, str) or not value:
            raise self._fail(key, "text")
        return value

    def name(self, key: str) -> str:
        return check_name(self.text(key), self._path, f"{self._where}.{key}")

    def integer(self, key: str) -> int:
        value = self._get(key)
        whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
        if isinstance(value, bool) or not whole or not 0 <= value < MAX_INTEGER:
            raise self._fail(key, f"an integer from 0 to {MAX_INTEGER - 1}")
        return int(value)

    def number(self, key: str) -> float:
        value = self._get(key)
        number = math.nan
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            with suppress(OverflowError):  # JSON integers have no bound
                number = float(value)
        if not math.isfinite(number):
            raise self._fail(key, "a finite number")
        return number


def read_matrix(file: Path, key: str, value: Any, size: int) -> FloatArray:
    """(size, size) matrix of a JSON. Raises `InputError` for anything but finite numbers of that shape."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise InputError(file, key, f"a {size}x{size} matrix of finite numbers", found_entry(value))
    return matrix


def read_rigid(file: Path, key: str, value: Any) -> FloatArray:
    """(4, 4) rigid motion of a JSON. Raises `InputError` for another matrix."""
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
