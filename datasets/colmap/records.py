"""What a COLMAP sparse model says of cameras and images; tests of each before it is believed."""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pycolmap as pycolmap  # noqa: PLC0414 - the writer imports it from here

from ...bench.errors import InputError
from ...bench.io.files import check_name

# Its import replaces the handler of SIGTERM by one that prints a stack, behind the interpreter's back.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)

_MAX_PIXELS = 1 << 20  # along one side: far beyond any sensor
_UNIT_TOLERANCE = 1e-3  # of a quaternion's length; COLMAP itself normalises what it reads


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
    """Cameras and images of a model by COLMAP's numbers. The unit of length is the model's own."""

    folder: Path
    cameras: Mapping[int, ColmapCamera]
    images: Mapping[int, ColmapImage]


@cache
def camera_models() -> dict[int, tuple[str, int]]:
    """Name and number of parameters of the camera models pycolmap knows, by COLMAP's number."""
    models = {}
    for name, number in pycolmap.CameraModelId.__members__.items():
        if name != "INVALID":
            camera = pycolmap.Camera.create_from_model_name(1, name, 1.0, 1, 1)
            models[int(number)] = (name, len(camera.params))
    return models


def checked_camera(file: Path, number: int, camera: ColmapCamera) -> ColmapCamera:
    """Return the camera, or raise `InputError` where its size or a parameter makes no sense."""
    key = f"camera {number}"
    if not (0 < camera.width <= _MAX_PIXELS and 0 < camera.height <= _MAX_PIXELS):
        raise InputError(file, key, "an image size in pixels", f"{camera.width}x{camera.height}")
    if not np.isfinite(camera.params).all():
        raise InputError(file, key, "finite parameters", str(camera.params))
    return camera


def checked_image(file: Path, number: int, image: ColmapImage) -> ColmapImage:
    """Return the image, or raise `InputError` for an unfit name or a pose that is no rigid motion."""
    key = f"image {number}"
    for part in image.name.split("/"):
        check_name(part, file, f"{key}, name")
    if not np.isfinite([*image.quaternion, *image.translation]).all():
        raise InputError(file, key, "a finite pose", f"{image.quaternion}, {image.translation}")
    length = math.hypot(*image.quaternion)
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise InputError(file, key, "a unit quaternion", f"one of length {length:.4g}")
    return image
