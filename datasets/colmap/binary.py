"""Read cameras.bin and images.bin. Every count and length is held against the bytes there before it is used.

The files come from outside, and pycolmap's own reader trusts them: cut short, they make it return wrong numbers,
run out of memory or not return at all.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any, BinaryIO

from ...bench.errors import InputError
from .records import ColmapCamera, ColmapImage, camera_models, checked_camera, checked_image

_LONGEST_NAME = 1024
_POINT = struct.calcsize("<ddQ")  # x, y and the number of a point of the model


class _Reader:
    """Takes numbers off a file; `InputError` where it ends too early."""

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
        """Read how many entries follow, each of at least ``least`` bytes."""
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
        """Pass over bytes."""
        self._need(size, key)
        self._stream.seek(size, os.SEEK_CUR)

    def _need(self, size: int, key: str) -> None:
        if size > self.left:
            expected = f"{size} more bytes at byte {self._stream.tell()}"
            raise InputError(
                self.file, key, expected, f"{self.left}", "The file was cut short or is damaged."
            )

    def finish(self) -> None:
        """Check that nothing is left over."""
        if self.left:
            raise InputError(
                self.file, "", "the end of the file after the last entry", f"{self.left} more bytes"
            )


def read_cameras_binary(file: Path) -> dict[int, ColmapCamera]:
    """Cameras by number; `InputError` for whatever is wrong with the file."""
    models = camera_models()
    cameras: dict[int, ColmapCamera] = {}
    with file.open("rb") as stream:
        reader = _Reader(file, stream)
        for _ in range(reader.count(struct.calcsize("<IiQQ"), "cameras")):
            number, model, width, height = reader.take("IiQQ", "camera")
            key = f"camera {number}"
            if model not in models:
                raise InputError(file, key, "a camera model pycolmap knows", f"number {model}")
            name, length = models[model]
            params = reader.take(f"{length}d", key)
            if number in cameras:
                raise InputError(file, key, "each camera once", "a second one")
            cameras[number] = checked_camera(file, number, ColmapCamera(name, width, height, params))
        reader.finish()
    return cameras


def read_images_binary(file: Path) -> dict[int, ColmapImage]:
    """Images by number; `InputError` for whatever is wrong with the file."""
    images: dict[int, ColmapImage] = {}
    with file.open("rb") as stream:
        reader = _Reader(file, stream)
        for _ in range(reader.count(struct.calcsize("<I7dIQ") + 1, "images")):
            number, *pose, camera = reader.take("I7dI", "image")
            key = f"image {number}"
            name = reader.name(key)
            points = reader.count(_POINT, f"{key}, points")
            reader.skip(points * _POINT, key)
            if number in images:
                raise InputError(file, key, "each image once", "a second one")
            image = ColmapImage(name, camera, tuple(pose[:4]), tuple(pose[4:]))
            images[number] = checked_image(file, number, image)
        reader.finish()
    return images
