"""Read cameras and images of a COLMAP sparse model, binary or text.

The files are untrusted, and pycolmap's own reader (4.2) does not validate them: of 220 truncations of an
``images.bin`` of three images, 72 gave wrong values without an error and 9 did not terminate; it also requires a file
of points, which many projects lack. Here every count and length is compared with the remaining bytes before it is
used.
"""

from __future__ import annotations

import importlib
import math
import os
import signal
import struct
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from ...bench.errors import InputError
from ...bench.io.documents import refuse_utf16
from ...bench.io.files import check_name, with_slashes


@cache
def pycolmap() -> Any:
    """The package pycolmap, imported when first used, without its handler of SIGTERM."""
    package = importlib.import_module("pycolmap")
    # Its import installs a handler in C that prints a stack.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return package


T = TypeVar("T")

_MAX_PIXELS = 1 << 20  # maximum pixels along one side, far above any sensor
_UNIT_TOLERANCE = 1e-3  # of a quaternion's length; COLMAP normalises quaternions when reading


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics. ``params`` are in the order of COLMAP's camera model ``model``, pixels."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """A registered image: its pose maps world points to camera points, quaternion with the real part first."""

    name: str
    camera: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]


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


def _check_camera(file: Path, key: str, camera: ColmapCamera) -> None:
    if not (0 < camera.width <= _MAX_PIXELS and 0 < camera.height <= _MAX_PIXELS):
        raise InputError(file, key, "an image size in pixels", f"{camera.width}x{camera.height}")
    if not np.isfinite(camera.params).all():
        raise InputError(file, key, "finite parameters", str(camera.params))


def _check_image(file: Path, key: str, image: ColmapImage) -> None:
    for part in image.name.split("/"):
        check_name(part, file, f"{key}, name")
    if not np.isfinite([*image.quaternion, *image.translation]).all():
        raise InputError(file, key, "a finite pose", f"{image.quaternion}, {image.translation}")
    length = math.hypot(*image.quaternion)
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise InputError(file, key, "a unit quaternion", f"one of length {length:.4g}")


def _by_number(
    file: Path, kind: str, entries: Iterable[tuple[int, T]], check: Callable[[Path, str, T], None]
) -> dict[int, T]:
    """Cameras or images by id, validated and unique."""
    found: dict[int, T] = {}
    for number, entry in entries:
        key = f"{kind} {number}"
        if number in found:
            raise InputError(file, key, f"each {kind} once", "a second one")
        check(file, key, entry)
        found[number] = entry
    return found


_LONGEST_NAME = 1024
_POINT = struct.calcsize("<ddQ")  # x, y and the number of a point of the model


class _BinaryReader:
    """Reads numbers from a file; raises `InputError` if it ends too early."""

    def __init__(self, file: Path, stream: BinaryIO) -> None:
        self.file, self._stream = file, stream
        self._size = os.fstat(stream.fileno()).st_size

    @property
    def left(self) -> int:
        """Bytes that remain."""
        return self._size - self._stream.tell()

    def take(self, layout: str, key: str) -> tuple[Any, ...]:
        """Read numbers in a little-endian `struct` layout."""
        size = struct.calcsize("<" + layout)
        self._need(size, key)
        return struct.unpack("<" + layout, self._stream.read(size))

    def count(self, least: int, key: str) -> int:
        """Read the number of following entries, each of at least ``least`` bytes."""
        (number,) = self.take("Q", key)
        self._need(number * least, f"{number} of {key}")
        return int(number)

    def name(self, key: str) -> str:
        """Read a text that ends with a zero byte."""
        start = self._stream.tell()
        text, end, _ = self._stream.read(_LONGEST_NAME + 1).partition(b"\0")
        if not end:
            raise InputError(self.file, key, f"a name of at most {_LONGEST_NAME} bytes", "no end of it")
        self._stream.seek(start + len(text) + 1)
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError(self.file, key, "a name in UTF-8", repr(text[:60])) from error

    def skip(self, size: int, key: str) -> None:
        """Skip bytes."""
        self._need(size, key)
        self._stream.seek(size, os.SEEK_CUR)

    def _need(self, size: int, key: str) -> None:
        if size > self.left:
            expected = f"{size} more bytes at byte {self._stream.tell()}"
            found = f"{self.left}"
            raise InputError(self.file, key, expected, found, "The file is truncated or damaged.")

    def finish(self) -> None:
        """Check that the file has no further bytes."""
        if self.left:
            expected = "the end of the file after the last entry"
            raise InputError(self.file, "", expected, f"{self.left} more bytes")


def _cameras_binary(file: Path) -> Iterator[tuple[int, ColmapCamera]]:
    models = camera_models()
    with file.open("rb") as stream:
        reader = _BinaryReader(file, stream)
        for _ in range(reader.count(struct.calcsize("<IiQQ"), "cameras")):
            number, model, width, height = reader.take("IiQQ", "camera")
            key = f"camera {number}"
            if model not in models:
                raise InputError(file, key, "a camera model pycolmap knows", f"number {model}")
            name, length = models[model]
            yield number, ColmapCamera(name, width, height, reader.take(f"{length}d", key))
        reader.finish()


def _images_binary(file: Path) -> Iterator[tuple[int, ColmapImage]]:
    with file.open("rb") as stream:
        reader = _BinaryReader(file, stream)
        for _ in range(reader.count(struct.calcsize("<I7dIQ") + 1, "images")):
            number, *pose, camera = reader.take("I7dI", "image")
            key = f"image {number}"
            name = with_slashes(reader.name(key))
            points = reader.count(_POINT, f"{key}, points")
            reader.skip(points * _POINT, key)
            yield number, ColmapImage(name, camera, tuple(pose[:4]), tuple(pose[4:]))
        reader.finish()


_LONGEST_LINE = 2**23  # 300,000 points of an image; words take ten times the memory of their line
_IMAGE_WORDS = 10  # number, quaternion, translation, camera, name


def _cameras_text(file: Path) -> Iterator[tuple[int, ColmapCamera]]:
    lengths = dict(camera_models().values())
    for line, text in _lines(file):
        words = text.split()
        if not words:
            continue
        key = f"line {line}"
        if len(words) < 4 or words[1] not in lengths:
            expected = "a number, a camera model pycolmap knows and a size"
            raise InputError(file, key, expected, " ".join(words)[:80])
        if len(words) != 4 + lengths[words[1]]:
            expected = f"{lengths[words[1]]} parameters of {words[1]}"
            raise InputError(file, key, expected, f"{len(words) - 4}")
        number, width, height = _whole(file, key, [words[0], words[2], words[3]])
        yield number, ColmapCamera(words[1], width, height, _real(file, key, words[4:]))


def _images_text(file: Path) -> Iterator[tuple[int, ColmapImage]]:
    lines = _lines(file)
    for line, text in lines:
        words = text.strip().split(maxsplit=_IMAGE_WORDS - 1)  # the name, which comes last, may have spaces
        if not words:
            continue
        key = f"line {line}"
        if len(words) != _IMAGE_WORDS:
            raise InputError(file, key, f"{_IMAGE_WORDS} words of an image", f"{len(words)}")
        number, camera = _whole(file, key, [words[0], words[8]])
        pose = _real(file, key, words[1:8])
        yield number, ColmapImage(with_slashes(words[9]), camera, pose[:4], pose[4:])
        _, points = next(lines, (0, "missing"))
        if len(points.split()) % 3:
            expected = "the image's points, three numbers each"
            raise InputError(file, f"line {line + 1}", expected, "another line")


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Number and text of each line except comments. An empty line may be an image without points."""
    try:
        with file.open("rb") as start:
            refuse_utf16(start.read(4), file, "text in UTF-8")
        with file.open(encoding="utf-8-sig") as stream:
            for number, line in enumerate(iter(partial(stream.readline, _LONGEST_LINE + 1), ""), start=1):
                if len(line) > _LONGEST_LINE:
                    expected = f"at most {_LONGEST_LINE} characters in a line"
                    raise InputError(file, f"line {number}", expected, "more")
                if not line.startswith("#"):
                    yield number, line
    except UnicodeDecodeError as error:
        raise InputError(file, "", "text in UTF-8", str(error)) from error


def _whole(file: Path, key: str, words: list[str]) -> list[int]:
    if not all(word.isascii() and word.isdigit() and len(word) < 20 for word in words):
        raise InputError(file, key, "whole numbers", ", ".join(words)[:80])
    return [int(word) for word in words]


def _real(file: Path, key: str, words: list[str]) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
    except ValueError as error:
        raise InputError(file, key, "numbers", " ".join(words)[:80]) from error


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
    cameras = _by_number(
        files[0], "camera", (_cameras_binary if binary else _cameras_text)(files[0]), _check_camera
    )
    images = _by_number(
        files[1], "image", (_images_binary if binary else _images_text)(files[1]), _check_image
    )
    for number, image in images.items():
        if image.camera not in cameras:
            expected = "one of the model's cameras"
            raise InputError(files[1], f"image {number}, camera", expected, str(image.camera))
    return ColmapModel(files, cameras, images)
