"""Cameras for code that takes the middle of the image for the principal point: windows of the image, centred on it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ....bench.contracts import ByteArray, Camera, FloatArray
from ....bench.errors import InputError

LARGEST_ERROR = 0.1
"""Pixels by which a projection may be off at the image's border, where pixels are not quite square or have a skew."""


@dataclass(frozen=True, eq=False)
class Window:
    """A box of a camera's image with the principal point in its middle.

    Attributes
    ----------
    camera : of the box; its principal point is the middle exactly, its focal length one for both axes.
    left, top : of the box in the image, whole pixels; negative where it begins outside.
    """

    camera: Camera
    left: int
    top: int

    def cut(self, image: ByteArray) -> ByteArray:
        """What an image of the camera has inside the box, which lies inside of it."""
        rows = slice(self.top, self.top + self.camera.height)
        return np.ascontiguousarray(image[rows, self.left : self.left + self.camera.width])

    def uncut(self, image: ByteArray, camera: Camera) -> ByteArray:
        """The image of the camera, out of one of the box, which lies around it."""
        rows = slice(-self.top, camera.height - self.top)
        return np.ascontiguousarray(image[rows, -self.left : camera.width - self.left])


def inside(camera: Camera) -> Window:
    """The largest window inside the image: what training is shown, since nothing is known beyond the image."""
    return _window(camera, grow=False)


def around(camera: Camera) -> Window:
    """The smallest window around the image: what is rendered, and the image cut out of it again."""
    return _window(camera, grow=True)


def check_square_pixels(camera: Camera, where: str) -> None:
    """Raise `InputError` for a camera whose pixels are not square, or skewed, by so much that it shows."""
    K = np.asarray(camera.K, np.float64)
    off = max(abs(K[1, 1] / K[0, 0] - 1) * camera.height, abs(K[0, 1] / K[0, 0]) * camera.width) / 2
    if off > LARGEST_ERROR:
        found = f"focal lengths {K[0, 0]:.2f} and {K[1, 1]:.2f}, skew {K[0, 1]:.2f}"
        raise InputError(where, f"camera {camera.id}", "square pixels; the code knows no others", found)


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
    """Length and begin of a window along one axis, and how far right of its middle the principal point is.

    The last is a quarter of a pixel at most, since begins and ends are whole pixels.
    """
    shift = math.floor(size - 2 * center + 0.5)
    length = size + abs(shift) if grow else size - abs(shift)
    if length < 1:
        raise InputError("camera", "K", f"a principal point inside the image, {size} pixels", f"{center:.1f}")
    # Shift > 0: the principal point lies left of the middle. Growing adds to the left, shrinking takes from the right.
    begin = (-shift if shift > 0 else 0) if grow else (0 if shift > 0 else -shift)
    return length, begin, center - begin - length / 2


def _towards(direction: FloatArray) -> FloatArray:
    """The smallest rotation that turns a direction into the optical axis."""
    unit = direction / np.linalg.norm(direction)
    axis = np.cross(unit, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-15:
        return np.eye(3)
    rotation, _ = cv2.Rodrigues(axis / sine * math.atan2(sine, float(unit[2])))
    return np.asarray(rotation, np.float64)
