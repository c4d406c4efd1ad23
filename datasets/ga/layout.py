"""The GaussianAvatars/VHAP capture layout: names, keys and conventions, for reading and writing.

A capture is a *union* folder beside its *sequence* folders::

    UNION2_074/                         transforms_{train,val,test}.json, canonical_flame_param.npz,
                                        sequences_trainval.txt, sequences_test.txt
    074_EMO-1-shout+laugh_v16_.../      images/%05d_%02d.png (timestep_camera), fg_masks/%05d_%02d.png,
                                        flame_param/%05d.npz, canonical_flame_param.npz,
                                        transforms.json, transforms_{train,val,test}.json

Two additional files may be beside the JSONs: ``headbench.json`` (a `Declaration` of properties that the layout does
not define) and ``head_model.npz``. Other tools ignore them. `writer` writes the layout, `reader` reads it.

Conventions: ``transform_matrix`` is camera-to-world with OpenGL axes (x right, y up, looking along -z);
VHAP measures ``cy`` from the bottom edge since its commit 34afb35 (November 2024), from the top before.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...bench.contracts import Camera, FloatArray
from ...bench.errors import InputError
from ...bench.io.documents import checked, read_json, shown
from ...bench.io.files import check_name, json_text, with_slashes, write_json
from ..head.geometry import ANGLE_BITS, on_grid

CyConvention = Literal["top", "bottom", "centre"]
"""Convention of the principal point: ``cy`` from the top edge, from the bottom edge, or the image centre instead of
``cx`` and ``cy``, as in GaussianAvatars."""

SPLIT_FILES = {
    "train": "transforms_train.json",
    "novel_view": "transforms_val.json",
    "self_reenactment": "transforms_test.json",
}
ALL_FRAMES_FILE = "transforms.json"
CANONICAL_FILE = "canonical_flame_param.npz"
TRACKING_FOLDER = "flame_param"
DECLARATION_FILE = "headbench.json"
HEAD_FILE = "head_model.npz"
TRAIN_SEQUENCES_FILE = "sequences_trainval.txt"
TEST_SEQUENCES_FILE = "sequences_test.txt"
FORMAT_VERSION = 1

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Converts a camera-to-world matrix between OpenCV and OpenGL axes when multiplied from the right."""

_SEQUENCE_FOLDER = re.compile(r"(?P<subject>[^_]+)_(?P<sequence>.+?)(?:_v\d+(?:_.*)?)?")
_UNION_FOLDER = re.compile(r"UNION\d*_(?P<subject>[^_]+)(?:_.*)?")


def frame_name(timestep: int, camera_index: int) -> str:
    """Stem of an image or mask: ``00012_08``."""
    return f"{timestep:05d}_{camera_index:02d}"


def parameter_name(timestep: int) -> str:
    """File of a timestep's tracked parameters: ``00012.npz``."""
    return f"{timestep:05d}.npz"


def parse_sequence_folder(name: str) -> tuple[str, str]:
    """Subject and sequence in the name of a sequence folder; ("", name) if it follows no pattern."""
    match = _SEQUENCE_FOLDER.fullmatch(name)
    return (match["subject"], match["sequence"]) if match else ("", name)


def parse_union_folder(name: str) -> str:
    """Subject in the name of a union folder, or "" if it follows no pattern."""
    match = _UNION_FOLDER.fullmatch(name)
    return match["subject"] if match else ""


def intrinsics_to_json(camera: Camera, cy: CyConvention) -> dict[str, float | int]:
    """Intrinsic entries of a frame. ``camera_angle_*`` are full angles in radians."""
    width, height = camera.width, camera.height
    fl_x, fl_y = float(camera.K[0, 0]), float(camera.K[1, 1])
    cy_top = float(camera.K[1, 2])
    return {
        "cx": float(camera.K[0, 2]),
        "cy": height - cy_top if cy == "bottom" else cy_top,
        "fl_x": fl_x,
        "fl_y": fl_y,
        "h": height,
        "w": width,
        "camera_angle_x": float(on_grid(2 * math.atan(width / (2 * fl_x)), ANGLE_BITS)),
        "camera_angle_y": float(on_grid(2 * math.atan(height / (2 * fl_y)), ANGLE_BITS)),
    }


def intrinsics_from_json(
    entries: Mapping[str, float], width: int, height: int, cy: CyConvention
) -> FloatArray:
    """(3, 3) K in pixels of OpenCV's image axes, from the available intrinsic entries of a frame.

    Uses ``fl_x`` (and ``fl_y``, ``cx``, ``cy``) if present; otherwise square pixels from ``camera_angle_x``
    with the principal point at the image centre, as GaussianAvatars reads it.
    """
    fl_x = entries.get("fl_x") or width / (2 * math.tan(entries["camera_angle_x"] / 2))
    fl_y = entries.get("fl_y") or fl_x
    center_x, center_y = width / 2, height / 2
    if cy != "centre":
        center_x = entries.get("cx", center_x)
        if "cy" in entries:
            center_y = height - entries["cy"] if cy == "bottom" else entries["cy"]
    return np.array([[fl_x, 0.0, center_x], [0.0, fl_y, center_y], [0.0, 0.0, 1.0]])


def extrinsics_to_json(world_to_camera: FloatArray) -> list[list[float]]:
    """4x4 camera-to-world with OpenGL axes, from world-to-camera with OpenCV axes."""
    # The inverse is computed by cofactors because LAPACK's last digits differ between machines.
    a, b, c = world_to_camera[:3, :3]
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    matrix[:3, :3] /= (a * matrix[:3, 0]).sum()
    matrix[:3, 3] = -(matrix[:3, :3] * world_to_camera[:3, 3]).sum(axis=1)
    matrix[:3, 1:3] *= -1.0
    entries: list[list[float]] = (matrix + 0.0).tolist()
    return entries


def extrinsics_from_json(transform_matrix: FloatArray) -> FloatArray:
    """4x4 world-to-camera with OpenCV axes, from camera-to-world with OpenGL axes."""
    return np.linalg.inv(transform_matrix @ OPENGL_FROM_OPENCV)


@dataclass(frozen=True)
class Declaration:
    """``headbench.json``: properties that the layout does not define."""

    subject: str
    head_model: str
    """Version of the head model of the parameters."""
    head_file: str = HEAD_FILE
    """Head model file, relative to the declaration's folder."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """(r, g, b) in [0, 1] that the images are composited on."""
    cy: CyConvention = "bottom"
    """Convention of the JSONs' principal point."""
    sequences: Mapping[str, str] = field(default_factory=dict)
    excluded: Mapping[int, str] = field(default_factory=dict)
    """Reason by timestep index of the folder's JSONs, for frames excluded from all splits."""
    synthetic: Mapping[str, Any] = field(default_factory=dict)
    """How the capture was synthesised; empty for a recording."""
    cut: str = ""
    """What was replaced by background below the head: "bust-line", "parsing", or "" if nothing is known of it."""

    def write(self, folder: Path) -> None:
        """Write ``headbench.json`` into ``folder``."""
        write_json(folder / DECLARATION_FILE, self._content())

    def digest(self, sequences: Iterable[str]) -> str:
        """Digest of the file that `write` makes, with ``sequences`` in the order given."""
        names = sorted(self.sequences, key=[*sequences, *self.sequences].index)
        settings = sorted(self.synthetic, key=[*_SYNTHETIC, *sorted(self.synthetic)].index)
        ordered = replace(
            self,
            sequences={name: self.sequences[name] for name in names},
            synthetic={name: self.synthetic[name] for name in settings},
        )
        return hashlib.sha256(json_text(ordered._content()).encode()).hexdigest()

    def _content(self) -> dict[str, Any]:
        excluded = [{"timestep": t, "reason": reason} for t, reason in sorted(self.excluded.items())]
        content = {"format_version": FORMAT_VERSION, **vars(self), "excluded": excluded}
        return content if self.cut else {name: content[name] for name in content if name != "cut"}

    @classmethod
    def read(cls, folder: Path) -> Declaration | None:
        """Read ``headbench.json`` of ``folder``; None if there is none. Raises `InputError` for an invalid file."""
        path = folder / DECLARATION_FILE
        if not path.exists():
            return None
        value = read_json(path)
        found = value.get("format_version")
        if found != FORMAT_VERSION:
            remedy = "Use the release of headbench that wrote it."
            raise InputError(path, "format_version", f"{FORMAT_VERSION}", shown(found), remedy)
        file = checked(value, _DeclarationFile, path)
        check_name(file.subject, path, "subject")
        for part, name in file.sequences.items():
            check_name(name, path, f"sequences.{part}")
        if not all(0 <= channel <= 1 for channel in file.background):
            raise InputError(path, "background", "three numbers in [0, 1]", str(file.background))
        values = {**vars(file), "head_file": with_slashes(file.head_file)}
        values |= {"excluded": {entry.timestep: entry.reason for entry in file.excluded}}
        del values["format_version"]
        return cls(**values)


_SYNTHETIC = (
    *("subjects", "cameras", "timesteps", "size", "head", "seed", "tracking_noise", "samples_per_pixel"),
    *("performance", "dynamics", "tracking_error", "tracker", "hair_lag", "camera_colour", "motion_blur"),
    *("mask_error", "correctives", "edition", "style"),
)
"""Keys of `Declaration.synthetic` in the order in which `headbench synth` writes them."""


@dataclass(frozen=True)
class _Exclusion:
    timestep: int
    reason: str


@dataclass(frozen=True)
class _DeclarationFile:
    """A declaration in the format of its file."""

    format_version: int
    subject: str
    head_model: str
    cy: CyConvention
    head_file: str = HEAD_FILE
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    sequences: dict[str, str] = field(default_factory=dict)
    excluded: tuple[_Exclusion, ...] = ()
    synthetic: dict[str, Any] = field(default_factory=dict)
    cut: Literal["", "bust-line", "parsing"] = ""
