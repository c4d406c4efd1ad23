"""Read cameras and images of a COLMAP sparse model, binary or text.

pycolmap's own reader (4.2) does not check files: of 220 truncations of an ``images.bin``, 72 gave wrong values without an
error and 9 did not terminate. It also needs a file of points, which many projects lack, and ends names at a space.

Removal of lens distortion from images, so that a pinhole camera describes them. Lenses are named and parametrised as
COLMAP does (its ``sensor/models.h``), which shares OpenCV's formulas. Pixel coordinates have the centre of the top left
pixel at (0.5, 0.5), in COLMAP as here.

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
from dataclasses import dataclass, replace
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from ...bench.contracts import FloatArray, FrameKey
from ...bench.errors import InputError
from ...bench.io.documents import read_text
from ...bench.io.files import check_name, read_bytes, reading, with_slashes
from ..clip import CaptureClip, FramePixels

_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}
_OUTSIDE = -1e4


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera with distortion."""

    model: str
    """COLMAP's name of the model: a pinhole, or a distortion that can be undone."""
    params: tuple[float, ...]
    """In COLMAP's order; lengths in pixels."""
    width: int
    height: int
    """Image size, pixels."""

    def check(self, file: Path, key: str) -> None:
        """Raise `InputError` for a model that is not known, or a size or parameter that no camera has."""
        if self.model not in _PARAMETERS:
            raise InputError(file, key, f"one of {', '.join(_PARAMETERS)}", self.model)
        names = _PARAMETERS[self.model].split()
        lengths = (self.width, self.height, *(self._by_name.get(name, 1) for name in ("f", "fx", "fy")))
        if len(self.params) != len(names) or not np.isfinite(self.params).all() or min(lengths) <= 0:
            expected = f"a size in pixels, and {', '.join(names)}: finite numbers, focal lengths above 0"
            raise InputError(file, key, expected, f"{self.model} {self.width}x{self.height} {self.params}")

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the same camera without its distortion."""
        values = self._by_name
        fx, fy = values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0))
        return np.array([[fx, 0, values["cx"]], [0, fy, values["cy"]], [0, 0, 1]])

    @property
    def distorts(self) -> bool:
        """Whether the lens has distortion; a fisheye lens without coefficients also does."""
        return self._fisheye or bool(self._coefficients.any())

    def map_from(self, K: FloatArray, width: int, height: int) -> FloatArray:
        """(height, width, 2) float32 position of each pixel of a pinhole image in the distorted one, pixels. Far
        outside the calibrated view a polynomial may fold back into the image; such positions are moved outside."""
        # OpenCV's origin is the centre of the top left pixel.
        half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        undo = cv2.fisheye.initUndistortRectifyMap if self._fisheye else cv2.initUndistortRectifyMap
        arguments = (self.K - half, self._coefficients, np.eye(3), np.asarray(K, np.float64) - half)
        places = np.stack(undo(*arguments, (width, height), cv2.CV_32FC1), axis=-1) + np.float32(0.5)
        places[~_unfolded(places, K)] = _OUTSIDE
        return places

    @property
    def _fisheye(self) -> bool:
        return self.model.endswith("FISHEYE")

    @property
    def _by_name(self) -> dict[str, float]:
        return dict(zip(_PARAMETERS[self.model].split(), self.params))

    @property
    def _coefficients(self) -> FloatArray:
        """Distortion coefficients in OpenCV's order."""
        names = "k1 k2 k3 k4" if self._fisheye else "k1 k2 p1 p2 k3 k4 k5 k6"
        return np.array([self._by_name.get(name, 0.0) for name in names.split()])


def _unfolded(places: FloatArray, K: FloatArray) -> np.ndarray:
    """(H, W) bool: connected region around the principal point in which a map keeps its orientation. Outside a ring in
    which the lens's polynomial decreases it may increase again, mirrored twice."""
    height, width = places.shape[:2]
    if min(width, height) < 2:
        return np.ones((height, width), dtype=bool)
    down, across = (np.asarray(change) for change in np.gradient(places, axis=(0, 1)))
    upright = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0] > 0
    _, parts = cv2.connectedComponents(upright.astype(np.uint8), connectivity=4)
    x = int(np.clip(K[0, 2], 0, width - 1))
    y = int(np.clip(K[1, 2], 0, height - 1))
    return upright & (parts == parts[y, x])


def undistort_image(image: FloatArray, places: FloatArray, background: FloatArray | float) -> FloatArray:
    """Resample a float32 image (H, W) or (H, W, 3) by a map of `Lens.map_from`; ``background`` outside of it. Bicubic,
    with places rounded to 1/32 pixel, and clamped to [0, 1]."""
    ground = [float(value) for value in np.broadcast_to(np.asarray(background, np.float64), (3,))]
    x, y = (np.ascontiguousarray(places[..., axis] - np.float32(0.5)) for axis in (0, 1))
    moved = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=ground)
    return np.clip(moved, 0, 1).astype(np.float32, copy=False)


def undistort_clip(clip: CaptureClip, lenses: Mapping[str, Lens]) -> CaptureClip:
    """The clip with distortion removed from images and masks; pixels outside the distorted image are background.

    Each different lens holds a map of 8 bytes per pixel while the clip lives.

    ``lenses``: Lens by camera id; cameras without one have no distortion.
    """
    bent = {name: lens for name, lens in lenses.items() if lens.distorts}
    if not bent:
        return clip
    cameras = {**clip.cameras, **{name: replace(clip.cameras[name], K=lens.K) for name, lens in bent.items()}}
    lens_of = {clip.recorded(key).camera: bent[key.camera] for key in clip.files if key.camera in bent}
    maps = {lens: lens.map_from(lens.K, lens.width, lens.height) for lens in set(lens_of.values())}
    ground = np.asarray(clip.background, dtype=np.float32)

    def undistort(key: FrameKey, pixels: FramePixels) -> FramePixels:
        if key.camera not in lens_of:
            return pixels
        places = maps[lens_of[key.camera]]
        coverage = pixels.coverage
        if coverage is not None:
            coverage = undistort_image(coverage, places, 0.0)
        return FramePixels(undistort_image(pixels.image, places, ground), coverage)

    parameters = {name: [lens.model, list(lens.params)] for name, lens in sorted(bent.items())}
    return clip.derive_pixels("undistort", {"lenses": parameters}, undistort, cameras=cameras)


@cache
def pycolmap() -> Any:
    """The package pycolmap, imported when first used, without its handler of SIGTERM."""
    package = importlib.import_module("pycolmap")
    # Its import installs a handler in C that prints a stack.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return package


T = TypeVar("T", "Lens", "ColmapImage")
_UNIT_TOLERANCE = 1e-3  # of a quaternion's length; COLMAP normalises quaternions when reading
_POINT = struct.calcsize("<ddQ")  # x, y and the number of a point of the model


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
    cameras: Mapping[int, Lens]
    images: Mapping[int, ColmapImage]

    @property
    def folder(self) -> Path:
        """Folder of the files."""
        return self.files[0].parent


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


def _cameras_binary(file: Path) -> Iterator[tuple[int, Lens]]:
    stream = _Bytes(file)
    models = {int(number): name for name, number in pycolmap().CameraModelId.__members__.items()}
    for _ in stream.entries("cameras"):
        number, model, width, height = stream.numbers("IiQQ", "camera")
        name = models.get(model, f"number {model}")
        count = len(_PARAMETERS.get(name, "").split())
        yield number, Lens(name, stream.numbers(f"{count}d", f"camera {number}"), width, height)


def _images_binary(file: Path) -> Iterator[tuple[int, ColmapImage]]:
    stream = _Bytes(file)
    for _ in stream.entries("images"):
        number, *pose, camera = stream.numbers("I7dI", "image")
        name = stream.name(f"image {number}")
        stream.take(stream.numbers("Q", f"image {number}")[0] * _POINT, f"image {number}, points")
        yield number, ColmapImage(with_slashes(name), camera, tuple(pose[:4]), tuple(pose[4:]))


def _cameras_text(file: Path) -> Iterator[tuple[int, Lens]]:
    for line, text in _lines(file):
        if words := text.split():
            with reading(file, "a number, a camera model, a size and parameters", f"line {line}"):
                number, model, width, height, *params = words
                yield int(number), Lens(model, tuple(map(float, params)), int(width), int(height))


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
    """Read cameras and images of the model that `find_model` finds."""
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
    items: dict[int, T] = {}
    for number, entry in entries:
        key = f"{kind} {number}"
        if number in items:
            raise InputError(file, key, f"each {kind} once", "a second one")
        entry.check(file, key)
        items[number] = entry
    return items
