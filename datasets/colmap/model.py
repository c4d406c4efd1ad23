"""Read cameras and images of a COLMAP sparse model, binary or text.

pycolmap's own reader (4.2) does not check files: of 220 truncations of an ``images.bin``, 72 gave wrong values without an
error and 9 did not terminate. It also needs a file of points, which many projects lack, and ends names at a space.

Formats read:

- COLMAP models, binary. Written by colmap/colmap (`src/colmap/scene/reconstruction_io_binary.cc`). Checked on
  bartoszek/test_colmap@79fce7a6 `dense/0/sparse/images.bin` (its points project to its keypoints, median 0.24 pixels).
- COLMAP models, text. Written by colmap/colmap (`src/colmap/scene/reconstruction_io_text.cc`). Checked on
  HexGP/nerf-prep@b0b31be3 `colmap_text/images.txt` (equal to its binary model).
"""

from __future__ import annotations

import importlib
import math
import signal
import struct
import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ...bench.errors import InputError
from ...bench.io.documents import read_text
from ...bench.io.files import check_name, read_bytes, reading, with_slashes


@cache
def pycolmap() -> Any:
    """The package pycolmap, imported when first used, without its handler of SIGTERM."""
    package = importlib.import_module("pycolmap")
    # Its import installs a handler in C that prints a stack.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return package


T = TypeVar("T", "ColmapCamera", "ColmapImage")
_UNIT_TOLERANCE = 1e-3  # of a quaternion's length; COLMAP normalises quaternions when reading
_POINT = struct.calcsize("<ddQ")  # x, y and the number of a point of the model


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics. ``params`` are in the order of COLMAP's camera model ``model``, pixels."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def check(self, file: Path, key: str) -> None:
        """Raise `InputError` for a model that pycolmap does not know, or a size or parameter that no camera has."""
        count = dict(camera_models().values()).get(self.model)
        if (
            count != len(self.params)
            or min(self.width, self.height) < 1
            or not np.isfinite(self.params).all()
        ):
            expected = "a camera model pycolmap knows, a size in pixels and the model's parameters, finite"
            raise InputError(file, key, expected, f"{self.model} {self.width}x{self.height} {self.params}")


@dataclass(frozen=True)
class ColmapImage:
    """A registered image: its pose maps world points to camera points, quaternion with the real part first."""

    name: str
    camera: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]

    def check(self, file: Path, key: str) -> None:
        """Raise `InputError` for a name that leaves the folder of images, or an invalid pose."""
        for part in self.name.split("/"):
            check_name(part, file, f"{key}, name")
        length = math.hypot(*self.quaternion)
        if not np.isfinite(self.translation).all() or not abs(length - 1) < _UNIT_TOLERANCE:
            found = f"{self.translation} and a quaternion of length {length:.4g}"
            raise InputError(file, key, "a finite position and a unit quaternion", found)


@dataclass(frozen=True)
class ColmapModel:
    """Cameras and images of a model by COLMAP's ids. The unit of length is the model's own."""

    files: tuple[Path, Path]  # of the cameras and of the images
    cameras: Mapping[int, ColmapCamera]
    images: Mapping[int, ColmapImage]

    @property
    def folder(self) -> Path:
        """Folder of the files."""
        return self.files[0].parent


@cache
def camera_models() -> dict[int, tuple[str, int]]:
    """Name and number of parameters of the camera models pycolmap knows, by COLMAP's number."""
    names = {int(number): name for name, number in pycolmap().CameraModelId.__members__.items()}
    create = pycolmap().Camera.create_from_model_name
    return {
        k: (name, len(create(1, name, 1.0, 1, 1).params)) for k, name in names.items() if name != "INVALID"
    }


class _Bytes:
    """The content of a file in order; raises `InputError` where it ends too early."""

    def __init__(self, file: Path) -> None:
        self.file, self._left = file, memoryview(read_bytes(file, "a file of a COLMAP model"))

    def take(self, size: int, key: str) -> memoryview:
        """The next bytes."""
        if size > len(self._left):
            found, remedy = str(len(self._left)), "The file is truncated or damaged."
            raise InputError(self.file, key, f"{size} more bytes", found, remedy)
        part, self._left = self._left[:size], self._left[size:]
        return part

    def numbers(self, layout: str, key: str) -> tuple[Any, ...]:
        """The next numbers, of a `struct` layout, little-endian."""
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout), key))

    def name(self, key: str) -> str:
        """The next text, which ends with a zero byte."""
        text = bytes(self._left[:4096]).partition(b"\0")[0]
        with reading(self.file, "a name in UTF-8", key):
            return str(self.take(len(text) + 1, key)[:-1], "utf-8")

    def entries(self, key: str) -> Iterator[None]:
        """As many as the file counts; no further bytes may follow the last one."""
        yield from (None for _ in range(*self.numbers("Q", key)))
        if self._left:
            raise InputError(
                self.file, "", "the end of the file after the last entry", f"{len(self._left)} more bytes"
            )


def _cameras_binary(file: Path) -> Iterator[tuple[int, ColmapCamera]]:
    stream = _Bytes(file)
    for _ in stream.entries("cameras"):
        number, model, width, height = stream.numbers("IiQQ", "camera")
        name, count = camera_models().get(model, (f"number {model}", 0))
        yield number, ColmapCamera(name, width, height, stream.numbers(f"{count}d", f"camera {number}"))


def _images_binary(file: Path) -> Iterator[tuple[int, ColmapImage]]:
    stream = _Bytes(file)
    for _ in stream.entries("images"):
        number, *pose, camera = stream.numbers("I7dI", "image")
        name = stream.name(f"image {number}")
        stream.take(stream.numbers("Q", f"image {number}")[0] * _POINT, f"image {number}, points")
        yield number, ColmapImage(with_slashes(name), camera, tuple(pose[:4]), tuple(pose[4:]))


def _cameras_text(file: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for line, text in _lines(file):
        if words := text.split():
            with reading(file, "a number, a camera model, a size and parameters", f"line {line}"):
                number, model, width, height, *params = words
                camera = ColmapCamera(model, int(width), int(height), tuple(map(float, params)))
                yield int(number), camera


def _images_text(file: Path) -> Iterator[tuple[int, ColmapImage]]:
    lines = _lines(file)
    for line, text in lines:
        if not text.strip():
            continue
        with reading(file, "ten words of an image, numbers before its name", f"line {line}"):
            # The name, which comes last, may have spaces.
            number, *pose, camera, name = text.strip().split(maxsplit=9)
            a, b, c, d, x, y, z = map(float, pose)
            yield int(number), ColmapImage(with_slashes(name), int(camera), (a, b, c, d), (x, y, z))
        _, points = next(lines, (0, "missing"))
        if len(points.split()) % 3:
            raise InputError(
                file, f"line {line + 1}", "the image's points, three numbers each", "another line"
            )


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Number and text of each line except comments. An empty line may be an image without points."""
    lines = enumerate(read_text(file, "COLMAP text").split("\n"), start=1)
    return ((number, line) for number, line in lines if not line.lstrip().startswith("#"))


def find_model(path: str | PathLike[str]) -> tuple[Path, Path] | None:
    """Files of cameras and images of the model in a folder or its ``sparse/0`` or ``sparse``; binary files are preferred."""
    for place in (".", "sparse/0", "sparse"):
        for suffix in (".bin", ".txt"):
            files = Path(path) / place / f"cameras{suffix}", Path(path) / place / f"images{suffix}"
            if all(file.is_file() for file in files):
                return files
    return None


def read_model(path: str | PathLike[str]) -> ColmapModel:
    """Read cameras and images of the model that `find_model` finds.

    Raises
    ------
    InputError
        There is no model, a file is truncated or damaged, or an image's camera is missing.
    """
    files = find_model(path)
    if files is None:
        expected = "a COLMAP model: cameras.bin and images.bin, or cameras.txt and images.txt"
        raise InputError(path, "", expected, "none in it, in sparse/0 or in sparse")
    binary = files[0].suffix == ".bin"
    read_cameras, read_images = (_cameras_binary, _images_binary) if binary else (_cameras_text, _images_text)
    cameras = _by_number(files[0], "camera", read_cameras(files[0]))
    images = _by_number(files[1], "image", read_images(files[1]))
    for number, image in images.items():
        if image.camera not in cameras:
            expected = "one of the model's cameras"
            raise InputError(files[1], f"image {number}, camera", expected, str(image.camera))
    return ColmapModel(files, cameras, images)


def _by_number(file: Path, kind: str, entries: Iterable[tuple[int, T]]) -> dict[int, T]:
    """Cameras or images by id, validated and unique."""
    found: dict[int, T] = {}
    for number, entry in entries:
        key = f"{kind} {number}"
        if number in found:
            raise InputError(file, key, f"each {kind} once", "a second one")
        entry.check(file, key)
        found[number] = entry
    return found
