"""Baselines without learning: the mean image, and the nearest training image.

They put metrics into perspective: a method that does not clearly beat them has learned little.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, Clip, FloatArray, Frame, FrameKey, HeadPose
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, TEXT, Member, read_arrays
from ...bench.io.images import read_pixels
from ...bench.protocol import evenly_with_ends
from ...datasets.images import write_image
from ..shared.avatar_files import TRACKED, write_arrays, write_record
from ..shared.loop import Fit, TrainingSummary
from ..shared.method import TrainedMethod
from .spec import MEAN_IMAGE, NEAREST_CAMERA, NearestCameraConfig

MEAN_FILE = "mean.npz"
INDEX_FILE = "index.npz"
IMAGE_FOLDER = "images"

_COLOR = Member("f", (3,), 1)
_MEAN = {"rgba": Member("f", ("H", "W", 4), 1, "f4"), "background": _COLOR, "head_model": TEXT}
_INDEX = {
    "head_model": TEXT,
    "background": _COLOR,
    "timesteps": Member("iu", ("T",)),
    "signals": Member("f", ("T", "D"), MAX_MAGNITUDE),
    "scales": Member("f", ("D",), MAX_MAGNITUDE),
    "centers": Member("f", ("C", 3)),
    "images": Member("i", ("T", "C")),
}


def resize(image: FloatArray, width: int, height: int) -> FloatArray:
    """Resize a float32 image: area means when shrinking, bilinear when growing; unchanged at its own size."""
    if image.shape[:2] == (height, width):
        return image
    shrinks = width * height < image.shape[0] * image.shape[1]
    mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=mode), dtype=np.float32)


def recomposite(
    rgb: FloatArray, alpha: FloatArray, was: Sequence[float] | FloatArray, background: Sequence[float]
) -> Frame:
    """Exchange the background under straight-alpha compositing: add (1 - alpha) (new - old)."""
    change = np.asarray(background, np.float32) - np.asarray(was, np.float32)
    exchanged = rgb + (1 - alpha[..., None]) * change if change.any() else rgb
    return Frame(np.clip(exchanged, 0, 1).astype(np.float32), alpha.astype(np.float32))


def _rgba(clip: Clip, key: FrameKey) -> ByteArray:
    """(H, W, 4) image and coverage, which is 1 without a mask."""
    rgb, mask = clip.image(key), clip.mask(key)
    return np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8) if mask is None else mask])


class _ImageAvatar:
    """An avatar that renders one of its stored images at the camera's size.

    ``arrays``: arrays of the images, including ``head_model`` and ``background``.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray]):
        self._head_model, self._background = str(arrays["head_model"]), arrays["background"]

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """The image at the camera's size. Raises `InputError` for a pose of another head model."""
        if pose.head_model != self._head_model:
            raise InputError("pose", "head_model", repr(self._head_model), repr(pose.head_model))
        rgba = resize(self._image(camera, pose), camera.width, camera.height)
        return recomposite(rgba[..., :3], rgba[..., 3], self._background, background)

    def _image(self, camera: Camera, pose: HeadPose) -> FloatArray:
        """(H, W, 4)."""
        raise NotImplementedError


class MeanImageAvatar(_ImageAvatar):
    """One image for every camera and pose."""

    def __init__(self, folder: Path):
        self._path = folder / MEAN_FILE
        arrays = read_arrays(self._path, _MEAN)
        super().__init__(arrays)
        self._rgba = arrays["rgba"]
        if not self._rgba.size:
            raise InputError(self._path, "rgba", "at least one pixel", f"shape {self._rgba.shape}")

    def files(self) -> Sequence[Path]:
        """The image."""
        return [self._path]

    def _image(self, camera: Camera, pose: HeadPose) -> FloatArray:
        return self._rgba


class MeanImage(TrainedMethod[None, MeanImageAvatar]):
    """Mean of all training images, at the size of the largest; budget and seed have no effect."""

    name, version = MEAN_IMAGE.name, MEAN_IMAGE.version
    config_class = type(None)

    def load(self, path: Path, *, device: str) -> MeanImageAvatar:
        """Read the avatar `fit` wrote."""
        return MeanImageAvatar(path)

    def _train(self, fit: Fit, config: None) -> None:
        clip, keys = fit.clip, fit.clip.splits["train"]
        cameras = [clip.cameras[key.camera] for key in keys]
        largest = max(cameras, key=lambda camera: camera.width * camera.height)
        total = np.zeros((largest.height, largest.width, 4))
        for done, key in enumerate(keys, 1):
            total += resize(_rgba(clip, key).astype(np.float32) / 255, largest.width, largest.height)
            fit.progress(done, len(keys))
        arrays = {
            "rgba": (total / len(keys)).astype(np.float32),
            "background": np.asarray(clip.background, np.float32),
            "head_model": np.array(clip.head.version),
        }
        write_arrays(fit.out / MEAN_FILE, arrays)
        write_record(fit, TrainingSummary(len(keys), len(keys), 0.0))


class NearestCameraAvatar(_ImageAvatar):
    """Renders a training image: nearest timestep by driving signal, then nearest camera by direction.

    The distance of two driving signals is Euclidean with every parameter divided by its standard deviation over the
    training timesteps, so that radians, metres and coefficients are comparable. The direction is that from the head's
    translation to the camera.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._index = read_arrays(folder / INDEX_FILE, _INDEX)
        super().__init__(self._index)
        self._check_index(folder / INDEX_FILE)

    def nearest(self, camera: Camera, pose: HeadPose) -> int:
        """Index of the training image to show."""
        signals, scales = self._index["signals"], self._index["scales"]
        signal = driving_signal(pose)
        if signal.shape != scales.shape:
            raise InputError("pose", "expression", f"{len(scales)} driving values", f"{len(signal)}")
        distances = (((signals - signal) / scales) ** 2).sum(1)
        # Among equally near timesteps the pose's own is preferred, since tracking may be constant.
        own = self._index["timesteps"] == (-1 if pose.timestep is None else pose.timestep)
        row = int(np.lexsort((~own, distances))[0])
        available = np.flatnonzero(self._index["images"][row] >= 0)
        origin = np.asarray(pose.translation, np.float64)
        towards = _unit(self._index["centers"][available] - origin)
        wanted = _unit((camera.center - origin)[None])[0]
        return int(self._index["images"][row, available[int(np.argmax(towards @ wanted))]])

    def files(self) -> Sequence[Path]:
        """The index and every image."""
        numbers = sorted(int(number) for number in self._index["images"].ravel() if number >= 0)
        return [self._folder / INDEX_FILE, *(image_path(self._folder, number) for number in numbers)]

    def _check_index(self, path: Path) -> None:
        images = self._index["images"]
        if not len(images) or not (images >= 0).any(axis=1).all():
            raise InputError(path, "images", "an image of each timestep, and a timestep", "none of one")
        if images.min() < -1 or images.max() >= images.size:
            found = f"numbers from {images.min()} to {images.max()}"
            raise InputError(path, "images", f"numbers from -1 to {images.size - 1}", found)
        if not (self._index["scales"] > 0).all():
            raise InputError(path, "scales", "numbers above 0", "others")
        for file in self.files():
            if not file.is_file():
                raise InputError(file, "", f"an image that {INDEX_FILE} names", "no such file")

    def _image(self, camera: Camera, pose: HeadPose) -> FloatArray:
        path = image_path(self._folder, self.nearest(camera, pose))
        pixels = read_pixels(path)
        if pixels.ndim != 3 or pixels.shape[2] != 4:
            raise InputError(path, "", "an 8-bit RGBA image", "something else")
        return pixels[..., [2, 1, 0, 3]].astype(np.float32) / 255


class NearestCamera(TrainedMethod[NearestCameraConfig, NearestCameraAvatar]):
    """Stores the training images and an index of their driving signals and cameras; budget and seed have no effect."""

    name, version = NEAREST_CAMERA.name, NEAREST_CAMERA.version
    config_class = NearestCameraConfig

    def load(self, path: Path, *, device: str) -> NearestCameraAvatar:
        """Read the avatar `fit` wrote."""
        return NearestCameraAvatar(path)

    def _train(self, fit: Fit, config: NearestCameraConfig) -> None:
        clip, timesteps = fit.clip, self._timesteps(fit.clip)
        row = {timestep: number for number, timestep in enumerate(timesteps)}
        keys = [key for key in clip.splits["train"] if key.timestep in row]
        column = {name: number for number, name in enumerate(sorted({key.camera for key in keys}))}
        images = np.full((len(row), len(column)), -1, dtype=np.int64)
        for number, key in enumerate(keys):
            write_image(image_path(fit.out, number), _rgba(clip, key))
            images[row[key.timestep], column[key.camera]] = number
            fit.progress(number + 1, len(keys))
        signals = np.stack([driving_signal(clip.poses[timestep]) for timestep in timesteps])
        spread = signals.std(0)
        arrays = {
            "head_model": np.array(clip.head.version),
            "background": np.asarray(clip.background, np.float32),
            "timesteps": np.array(timesteps),
            "signals": signals,
            # A parameter that is constant in training must not outweigh all others when it changes.
            "scales": np.where(spread > 1e-8, spread, 1.0),
            "centers": np.stack([clip.cameras[name].center for name in column]),
            "images": images,
        }
        write_arrays(fit.out / INDEX_FILE, arrays)
        write_record(fit, TrainingSummary(len(keys), len(keys), 0.0))

    def _timesteps(self, clip: Clip) -> list[int]:
        timesteps = sorted({key.timestep for key in clip.splits["train"]})
        most = self.config.max_timesteps
        return timesteps if most is None else evenly_with_ends(timesteps, max(most, 1))


def driving_signal(pose: HeadPose) -> FloatArray:
    """All driving parameters in one float64 vector."""
    return np.concatenate([np.asarray(getattr(pose, name), np.float64).ravel() for name in TRACKED])


def image_path(folder: Path, number: int) -> Path:
    """File of a kept training image."""
    return folder / IMAGE_FOLDER / f"{number:06d}.png"


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
