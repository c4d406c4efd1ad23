"""Effects of cameras and matting: response of each camera, motion blur, mask errors at hair.

The amounts are choices where no measurement is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from ...bench.contracts import BoolArray, Camera, FloatArray, IntArray
from ..rounding import COEFFICIENT_BITS, LENGTH_BITS, on_grid
from .fields import fractal_noise

SHUTTER_SECONDS = 0.003
"""NeRSemble's exposure time."""
APART_PIXELS, MOST = 0.25, 16
"""Largest motion between two sub-frames, pixels, unless there would be more sub-frames than that."""

EXPOSURE, BALANCE, GAMMA = 0.05, 0.02, 0.03
"""Standard deviations of the logarithms of a camera's gain, of those of its channels, and of its exponent: what we take to be
left after a calibration with a colour chart."""

MATTE_METRES, MATTE_PERIOD = 0.004, 0.02
"""Largest displacement of the outline of hair, and the spacing of the smooth field that it follows, in the scene."""
_SOFT = _BETWEEN = (
    0.002  # metres of a matte's soft edge, and over which an outline of hair turns into one of skin
)
ROOM = 0.5
"""Colour (sRGB) of the room behind the head, visible where a mask is too wide."""


@dataclass(frozen=True, eq=False)
class Response:
    """A camera's ``gains`` (3,) of linear light, after an ``exponent``."""

    gains: FloatArray
    exponent: float

    def __call__(self, rgb: FloatArray) -> FloatArray:
        """Apply the camera's response to linear light (..., 3)."""
        return self.gains * np.maximum(rgb, 0.0) ** self.exponent


def draw_response(level: float, seed: int, camera: int) -> Response:
    """Response of camera number ``camera`` of the rig of a capture with ``seed``, the same for all subjects."""
    drawn = np.random.default_rng([seed, camera, 31]).standard_normal(5)
    gains = np.exp(level * (EXPOSURE * drawn[0] + BALANCE * drawn[1:4]))
    return Response(on_grid(gains, COEFFICIENT_BITS), float(on_grid(np.exp(level * GAMMA * drawn[4]), 20)))


def sub_frames(metres: float, focal: float, distance: float, shutter: float) -> FloatArray:
    """(K,) moments of an exposure of ``shutter`` seconds, relative to its middle, of what moves by ``metres`` meanwhile.

    One where that is less than `APART_PIXELS` at a ``distance`` (metres) from a camera of a ``focal`` length (pixels).
    """
    pixels = float(on_grid(metres, LENGTH_BITS)) * focal / distance
    count = int(np.clip(np.ceil(pixels / APART_PIXELS), 1, MOST))
    return shutter * ((np.arange(count) + 0.5) / count - 0.5)


def exposed(frames: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Mean over sub-frames of linear straight colour (H, W, 3) and coverage (H, W): light adds up where it is covered."""
    if len(frames) == 1:
        return frames[0]
    alpha = sum((coverage for _, coverage in frames), np.zeros(1)) / len(frames)
    light = sum((rgb * coverage[..., None] for rgb, coverage in frames), np.zeros(1)) / len(frames)
    return light / np.maximum(alpha, 1e-6)[..., None] * (alpha[..., None] > 0.0), alpha


def outline(camera: Camera, vertices: FloatArray, faces: IntArray) -> BoolArray:
    """(H, W) whether triangles cover a pixel, ignoring occlusion."""
    seen = vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = seen @ camera.K.T
    # Pixel centres lie at halves; OpenCV takes them at whole numbers, here of sixteenths.
    corners = np.round((pixels[:, :2] / pixels[:, 2:] - 0.5) * 16.0).astype(np.int32)[faces]
    covered = np.zeros((camera.height, camera.width), np.uint8)
    for corner in corners:
        cv2.fillConvexPoly(covered, corner, 1, shift=4)
    return covered > 0


def hair_pixels(hair: BoolArray, skin: BoolArray, metre: float) -> FloatArray:
    """(H, W) in [0, 1] how far pixels belong to hair: 0 where skin is nearer, by what hair and skin cover (H, W).

    ``metre`` is the number of pixels of a metre at the head.
    """
    return np.clip((_distance(skin) - _distance(hair)) / max(_BETWEEN * metre, 1.0), 0.0, 1.0)


def _distance(covered: BoolArray) -> FloatArray:
    """(H, W) distance in pixels to the nearest pixel that is ``covered`` (H, W); far where none is."""
    return distance_transform_edt(~covered) if covered.any() else np.full(covered.shape, 1e6)


def matte(alpha: FloatArray, hair: FloatArray, level: float, metre: float, seed: int) -> FloatArray:
    """(H, W) coverage as a matting network gives it: at ``hair`` (H, W) without single hairs, and displaced.

    Parameters
    ----------
    alpha : FloatArray
        (H, W) coverage.
    level : float
        The outline of hair is displaced by up to `MATTE_METRES` times this; below 1, it also keeps a part of its hairs.
    seed : int
        Of the field that displaces.
    """
    reach = _SOFT * metre
    core = _distance(alpha <= 0.5) > reach
    if not core.any():
        return alpha
    inside = _distance(core) <= reach  # structures narrower than twice the reach are removed
    signed = np.where(inside, _distance(~inside) - 0.5, 0.5 - _distance(inside))
    rows, columns = np.indices(alpha.shape)
    place = np.stack([columns.ravel(), rows.ravel(), np.zeros(alpha.size)], axis=1).astype(np.float64)
    field = fractal_noise(place, MATTE_PERIOD * metre, seed, 2).reshape(alpha.shape)
    edge = signed + level * MATTE_METRES * metre * field
    found = np.clip(0.5 + edge / max(reach, 1.0), 0.0, 1.0)
    return alpha + min(level, 1.0) * hair * (found - alpha)
