"""Read cameras and images of a COLMAP sparse model, binary or text.

pycolmap's own reader (4.2) does not check files: of 220 truncations of an ``images.bin``, 72 gave wrong values without an
error and 9 did not terminate. It also needs a file of points, which many projects lack, and ends names at a space.
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
_IMAGE_WORDS = 10  # number, quaternion, translation, camera, name


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics. ``params`` are in the order of COLMAP's camera model ``model``, pixels."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def check(self, file: Path, key: str) -> None:
        """Raise `InputError` for a size or a parameter that no camera has."""
        if self.width < 1 or self.height < 1:
            raise InputError(file, key, "an image size in pixels", f"{self.width}x{self.height}")
        if not np.isfinite(self.params).all():
            raise InputError(file, key, "finite parameters", str(self.params))


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
    models = {}
    for name, number in pycolmap().CameraModelId.__members__.items():
        if name != "INVALID":
            camera = pycolmap().Camera.create_from_model_name(1, name, 1.0, 1, 1)
            models[int(number)] = (name, len(camera.params))
    return models


class _Bytes:
    """Little-endian numbers of a file, in order; raises `InputError` if it ends too early."""

    def __init__(self, file: Path) -> None:
        self.file, self._content, self._place = file, read_bytes(file, "a file of a COLMAP model"), 0

    def take(self, layout: str, key: str) -> tuple[Any, ...]:
        """Read numbers in a `struct` layout."""
        with reading(self.file, "a count that the file can hold", key):
            size = struct.calcsize("<" + layout)
        start, self._place = self._place, self._place + size
        if self._place > len(self._content):
            expected, found = f"{size} more bytes at byte {start}", f"{len(self._content) - start}"
            raise InputError(self.file, key, expected, found, "The file is truncated or damaged.")
        return struct.unpack_from("<" + layout, self._content, start)

    def name(self, key: str) -> str:
        """Read a text that ends with a zero byte."""
        end = self._content.find(b"\0", self._place)
        (text,) = self.take(f"{end + 1 - self._place if end >= 0 else len(self._content) + 1}s", key)
        with reading(self.file, "a name in UTF-8", key):
            return str(text[:-1], "utf-8")

    def finish(self) -> None:
        """Check that the file has no further bytes."""
        left = len(self._content) - self._place
        if left:
            raise InputError(self.file, "", "the end of the file after the last entry", f"{left} more bytes")


def _cameras_binary(file: Path) -> Iterator[tuple[int, ColmapCamera]]:
    stream, models = _Bytes(file), camera_models()
    for _ in range(*stream.take("Q", "cameras")):
        number, model, width, height = stream.take("IiQQ", "camera")
        key = f"camera {number}"
        if model not in models:
            raise InputError(file, key, "a camera model pycolmap knows", f"number {model}")
        name, length = models[model]
        yield number, ColmapCamera(name, width, height, stream.take(f"{length}d", key))
    stream.finish()


def _images_binary(file: Path) -> Iterator[tuple[int, ColmapImage]]:
    stream = _Bytes(file)
    for _ in range(*stream.take("Q", "images")):
        number, *pose, camera = stream.take("I7dI", "image")
        key = f"image {number}"
        name = stream.name(key)
        (points,) = stream.take("Q", key)
        stream.take(f"{points * _POINT}x", f"{key}, points")
        yield number, ColmapImage(with_slashes(name), camera, tuple(pose[:4]), tuple(pose[4:]))
    stream.finish()


def _cameras_text(file: Path) -> Iterator[tuple[int, ColmapCamera]]:
    lengths = dict(camera_models().values())
    for line, text in _lines(file):
        if words := text.split():
            if len(words) < 4 or len(words) - 4 != lengths.get(words[1]):
                expected = "a number, a camera model pycolmap knows, a size and the model's parameters"
                raise InputError(file, f"line {line}", expected, " ".join(words)[:80])
            with reading(file, "numbers", f"line {line}"):
                number, width, height = (int(words[place]) for place in (0, 2, 3))
                params = tuple(map(float, words[4:]))
            yield number, ColmapCamera(words[1], width, height, params)


def _images_text(file: Path) -> Iterator[tuple[int, ColmapImage]]:
    lines = _lines(file)
    for line, text in lines:
        words = text.strip().split(maxsplit=_IMAGE_WORDS - 1)  # the name, which comes last, may have spaces
        if not words:
            continue
        if len(words) != _IMAGE_WORDS:
            raise InputError(file, f"line {line}", f"{_IMAGE_WORDS} words of an image", f"{len(words)}")
        with reading(file, "numbers", f"line {line}"):
            number, camera = int(words[0]), int(words[8])
            pose = tuple(map(float, words[1:8]))
        yield number, ColmapImage(with_slashes(words[9]), camera, pose[:4], pose[4:])
        _, points = next(lines, (0, "missing"))
        if len(points.split()) % 3:
            expected = "the image's points, three numbers each"
            raise InputError(file, f"line {line + 1}", expected, "another line")


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Number and text of each line except comments. An empty line may be an image without points."""
    lines = enumerate(read_text(file, "COLMAP text").split("\n"), start=1)
    return ((number, line) for number, line in lines if not line.startswith("#"))


_PLACES = (".", "sparse/0", "sparse")


def find_model(path: str | PathLike[str]) -> tuple[Path, Path] | None:
    """Files of cameras and images of the model in a folder or its ``sparse/0`` or ``sparse``; binary files are preferred."""
    for place in _PLACES:
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
