"""Timesteps in files of trackers, ``checkpoint/00012.frame``: files of ``torch.save`` with dictionaries of arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.arrays import Member, check_arrays, read_saved
from ...bench.io.files import entries
from ..monocular.track import frame_number

FOLDER, SUFFIX = "checkpoint", ".frame"


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """One timestep as a tracker found it, in this project's units and axes; the same for all trackers.

    The head's root is at rest in the world of ``world_to_camera``: its motion is in the camera.

    Attributes
    ----------
    file, number : Path, int
        The tracker's file and the number in its name.
    width, height : int
        Size of the image that was tracked, pixels.
    K : FloatArray
        (3, 3), pixels of that image; its upper left corner is (0, 0).
    world_to_camera : FloatArray
        (4, 4) rigid motion, metres, OpenCV axes.
    shape, expression : FloatArray
        Coefficients, as many as the tracker has.
    neck, jaw, eyes : FloatArray
        (3,), (3,), (6,) axis-angle; eyes left, then right.
    eyelids : FloatArray
        (2,) left, right.
    """

    file: Path
    number: int
    width: int
    height: int
    K: FloatArray
    world_to_camera: FloatArray
    shape: FloatArray
    expression: FloatArray
    neck: FloatArray
    jaw: FloatArray
    eyes: FloatArray
    eyelids: FloatArray


Convert = Callable[[Path, int, Mapping[str, np.ndarray]], TrackedFrame]
"""Makes a timestep of a file's checked arrays, whose names have dots: ``flame.exp``."""


def frame_files(root: Path) -> dict[int, Path]:
    """Files of the timesteps by number, in ``root`` or its folder ``checkpoint``; {} if there are none.

    Raises `InputError` for a name without a number, and for two names with the same one.
    """
    found: dict[int, Path] = {}
    for path in entries(root, f"*{SUFFIX}") or entries(root / FOLDER, f"*{SUFFIX}"):
        number = frame_number(path, "", path.stem)
        if number in found:
            raise InputError(
                path, "", "every frame once", f"frame {number} again, which is {found[number].name} too"
            )
        found[number] = path
    return dict(sorted(found.items()))


def read_members(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a file, with dots in the names of those in dictionaries inside.

    Raises `InputError` as `read_saved` does; nothing in the file is executed.
    """
    found: dict[str, np.ndarray] = {}
    for name, value in read_saved(path).items():
        inside: Mapping[str, Any] = value if isinstance(value, dict) else {}
        named = {name: value, **{f"{name}.{key}": part for key, part in inside.items()}}
        found |= {key: array for key, array in named.items() if isinstance(array, np.ndarray)}
    return found


def read_frames(
    files: Mapping[int, Path], members: Mapping[str, Member], convert: Convert
) -> list[TrackedFrame]:
    """Read the timesteps of one video.

    Raises `InputError` for the first file that is damaged, lacks an array or has one of another shape than ``members``
    say or than the first file has, and where image size or identity differ from those of the first file.
    """
    frames: list[TrackedFrame] = []
    sizes: dict[str, int] = {}
    for number, path in files.items():
        arrays = read_members(path)
        sizes = check_arrays(path, arrays, members, sizes)
        frame = convert(path, number, arrays)
        frames.append(frame)
        first = frames[0]
        if (frame.width, frame.height) != (first.width, first.height):
            expected = f"{first.width}x{first.height}, as {first.file.name} has"
            raise InputError(
                path, "img_size", expected, f"{frame.width}x{frame.height}", "Track the video again."
            )
        change = float(np.abs(frame.shape - first.shape).max(initial=0.0))
        if not change <= SAME_IDENTITY:
            expected = f"the identity of {first.file.name}, as one video has"
            remedy = "Files of several runs may be mixed: track the video again into an empty folder."
            raise InputError(path, "flame.shape", expected, f"coefficients that differ by {change:g}", remedy)
    return frames


SAME_IDENTITY = 1e-5
"""Maximum difference of the identity coefficients of one video."""


def image_size(path: Path, arrays: Mapping[str, np.ndarray]) -> tuple[int, int]:
    """Width and height of the tracked image; files have height and width. Raises `InputError` for no size."""
    height, width = (int(value) for value in arrays["img_size"])
    if min(width, height) < 1:
        raise InputError(path, "img_size", "height and width in pixels", f"{height}, {width}")
    return width, height
