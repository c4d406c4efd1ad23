"""Windows of images centred on the principal point, for code that assumes it in the middle of the image."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import cv2
import numpy as np

from ....bench.contracts import ByteArray, Camera, Clip, FloatArray
from ....bench.errors import InputError

Image = TypeVar("Image", ByteArray, FloatArray)

LARGEST_ERROR = 0.1
"""Tolerance of a projection at the image's border in pixels, if pixels are not quite square or have a
skew."""


@dataclass(frozen=True, eq=False)
class Window:
    """A box of a camera's image with the principal point in its middle."""

    camera: Camera
    """Camera of the box, with the principal point exactly in the middle and one focal length for both axes."""
    left: int
    top: int
    """Position of the box in the image, whole pixels; negative if it begins outside."""

    def cut(self, image: ByteArray) -> ByteArray:
        """Crop of a camera's image to the box."""
        rows = slice(self.top, self.top + self.camera.height)
        return np.ascontiguousarray(image[rows, self.left : self.left + self.camera.width])

    def uncut(self, image: Image, camera: Camera) -> Image:
        """The image of the camera, cropped from one of the box around it."""
        rows = slice(-self.top, camera.height - self.top)
        return cast(Image, np.ascontiguousarray(image[rows, -self.left : camera.width - self.left]))

    def padded(self, image: ByteArray, fill: int) -> ByteArray:
        """An image (H, W, C) of the camera, padded with ``fill`` to the box around it."""
        whole = np.full((self.camera.height, self.camera.width, image.shape[2]), fill, np.uint8)
        whole[-self.top : image.shape[0] - self.top, -self.left : image.shape[1] - self.left] = image
        return whole


def inside(camera: Camera) -> Window:
    """The largest window inside the image, for training, since nothing is known beyond the image."""
    return _window(camera, grow=False)


def around(camera: Camera) -> Window:
    """The smallest window around the image, for rendering; the image is cropped from it."""
    return _window(camera, grow=True)


def cameras_of(clip: Clip, *splits: str) -> dict[str, Camera]:
    """Cameras of the frames of some splits, of all by default, by name and in the order of the names."""
    names = {key.camera for split in splits or clip.splits for key in clip.splits[split]}
    return {name: clip.cameras[name] for name in sorted(names)}


def check_square_pixels(camera: Camera, where: str) -> None:
    """Raise `InputError` for a camera with visibly non-square or skewed pixels."""
    K = np.asarray(camera.K, np.float64)
    off = max(abs(K[1, 1] / K[0, 0] - 1) * camera.height, abs(K[0, 1] / K[0, 0]) * camera.width) / 2
    if off > LARGEST_ERROR:
        found = f"focal lengths {K[0, 0]:.2f} and {K[1, 1]:.2f}, skew {K[0, 1]:.2f}"
        raise InputError(where, f"camera {camera.id}", "square pixels, which the code supports", found)


def _window(camera: Camera, *, grow: bool) -> Window:
    width, left, off_x = _span(camera.width, float(camera.K[0, 2]), grow)
    height, top, off_y = _span(camera.height, float(camera.K[1, 2]), grow)
    focal = float(camera.K[0, 0])
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    turned = np.eye(4)
    turned[:3, :3] = _towards(np.array([-off_x / focal, -off_y / focal, 1.0]))
    world_to_camera = turned @ np.asarray(camera.world_to_camera, np.float64)
    return Window(
        replace(camera, width=width, height=height, K=K, world_to_camera=world_to_camera), left, top
    )


def _span(size: int, center: float, grow: bool) -> tuple[int, int, float]:
    """Length and start of a window along one axis, and the offset of the principal point to the right of its middle.

    The offset is at most a quarter of a pixel, since starts and ends are whole pixels.
    """
    shift = math.floor(size - 2 * center + 0.5)
    length = size + abs(shift) if grow else size - abs(shift)
    if length < 1:
        raise InputError("camera", "K", f"a principal point inside the image, {size} pixels", f"{center:.1f}")
    # Shift > 0: the principal point lies left of the middle. Growing adds pixels at the left, shrinking removes them
    # at the right.
    begin = (-shift if shift > 0 else 0) if grow else (0 if shift > 0 else -shift)
    return length, begin, center - begin - length / 2


def _towards(direction: FloatArray) -> FloatArray:
    """The smallest rotation from a direction to the optical axis."""
    unit = direction / np.linalg.norm(direction)
    axis = np.cross(unit, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-15:
        return np.eye(3)
    rotation, _ = cv2.Rodrigues(axis / sine * math.atan2(sine, float(unit[2])))
    return np.asarray(rotation, np.float64)


def square(camera: Camera, side: int) -> Window:
    """The square window around an image with the principal point in its middle; pixels need not be square."""
    K = np.asarray(camera.K, np.float64)
    (left, off_x), (top, off_y) = (_centred(float(K[axis, 2]), side) for axis in range(2))
    if not _encloses(camera, side):
        raise InputError(f"camera {camera.id}", "side", f"{square_side([camera])} pixels or more", str(side))
    turned = np.eye(4)
    turned[:3, :3] = _towards(np.array([-off_x / K[0, 0], -off_y / K[1, 1], 1.0]))
    centred = np.array([[K[0, 0], 0.0, side / 2], [0.0, K[1, 1], side / 2], [0.0, 0.0, 1.0]])
    world_to_camera = turned @ np.asarray(camera.world_to_camera, np.float64)
    moved = replace(camera, width=side, height=side, K=centred, world_to_camera=world_to_camera)
    return Window(moved, left, top)


def square_side(cameras: Iterable[Camera]) -> int:
    """The smallest side of a square window by `square` around the image of each camera."""
    cameras = list(cameras)
    shortest = max(max(camera.width, camera.height) for camera in cameras)
    return next(side for side in itertools.count(shortest) if all(_encloses(c, side) for c in cameras))


def _encloses(camera: Camera, side: int) -> bool:
    for axis, size in enumerate((camera.width, camera.height)):
        begin, _ = _centred(float(camera.K[axis, 2]), side)
        if begin > 0 or begin + side < size:
            return False
    return True


def _centred(center: float, side: int) -> tuple[int, float]:
    """Start of a window with a point in its middle, and the offset of the point to the right of the middle, at most half a pixel."""
    begin = math.floor(center - side / 2 + 0.5)
    return begin, center - begin - side / 2
