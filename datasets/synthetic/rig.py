"""The recording rig: sixteen cameras in two rows on an arc, and the lamps around them.

Names and order are NeRSemble's (the list walks the columns from the subject's right to the left, upper row
before lower, but for the last column); the arc spans about 93 by 32 degrees. World axes are those of a
VHAP export: +y up, the face looks along +z, the head near the origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...bench.contracts import Camera, FloatArray
from ...bench.errors import InputError
from ..rounding import ANGLE_BITS, on_grid

FRONTAL = "222200037"
SERIALS = (
    *("222200042", "222200044", "222200046", "222200040", "222200036", "222200048", "220700191", "222200041"),
    *(FRONTAL, "222200038", "222200047", "222200043", "222200049", "222200039", "222200045", "221501007"),
)
_LOWER = {
    "222200044",
    "222200040",
    "222200048",
    "222200041",
    "222200038",
    "222200043",
    "222200039",
    "222200045",
}
_ARC = np.radians(93.0)
_RISE = np.radians(32.0)
_DISTANCE = 1.0  # metres from the head's middle
_FRAME_HEIGHT = 0.394  # metres of the scene that the image's height shows at the head's middle
_FRAME_WIDTH = 0.270

# The order in which fewer cameras are taken: the frontal one, then those that spread most.
_SPREAD = (8, 0, 15, 3, 12, 6, 5, 10, 1, 14, 7, 9, 2, 13, 4, 11)


@dataclass(frozen=True, eq=False)
class Light:
    """A distant lamp: unit direction towards it, (3,), and linear RGB irradiance, (3,)."""

    direction: FloatArray
    irradiance: FloatArray


def cameras(count: int, width: int, height: int, target: FloatArray, seed: int = 0) -> dict[str, Camera]:
    """``count`` cameras by serial, in canonical order, looking at ``target`` (3,).

    Every set holds the frontal camera. The principal point lies a little off the image's centre (below 1 %
    of the width, another one per capture), and all cameras share it, as one calibration does.
    """
    if not 1 <= count <= len(SERIALS):
        raise InputError("--cameras", "", f"1 to {len(SERIALS)} cameras", str(count))
    focal = _DISTANCE * min(width / _FRAME_WIDTH, height / _FRAME_HEIGHT)
    shift = np.random.default_rng([seed, 11]).uniform(-0.008, 0.008, 2) * width
    K = np.array(
        [[focal, 0.0, 0.5 * width + shift[0]], [0.0, focal, 0.5 * height + shift[1]], [0.0, 0.0, 1.0]]
    )
    chosen = sorted(_SPREAD[:count])
    return {SERIALS[i]: Camera(SERIALS[i], width, height, K, _look_at(*_place(i), target)) for i in chosen}


def _place(index: int) -> tuple[float, float]:
    """Azimuth (positive to the subject's left) and elevation of a camera, radians."""
    lower = SERIALS[index] in _LOWER
    azimuth = _ARC * (index // 2 / 7.0 - 0.5)
    if SERIALS[index] == FRONTAL:
        return 0.0, 0.0
    # The rows are staggered by half a column so that sixteen azimuths differ.
    azimuth += (0.25 if lower else -0.25) * _ARC / 7.0
    return float(np.clip(azimuth, -0.5 * _ARC, 0.5 * _ARC)), -0.4 * _RISE if lower else 0.6 * _RISE


def _look_at(azimuth: float, elevation: float, target: FloatArray) -> FloatArray:
    outward = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    )
    forward = -outward
    right = np.cross(forward, np.array([0.0, 1.0, 0.0]))
    right /= np.linalg.norm(right)
    rotation = on_grid(np.stack([right, np.cross(forward, right), forward]), ANGLE_BITS)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    # Along the rounded axis, and summed in one order: the JSONs state these numbers to the last digit.
    matrix[:3, 3] = -(rotation * (target - _DISTANCE * rotation[2])).sum(axis=1) + 0.0
    return matrix


def lights() -> tuple[Light, ...]:
    """Five lamps: key, fill, one from the camera's side, and two from behind that draw the outline.

    Five because the default 25 samples per pixel fall evenly on them (see `scene.SAMPLE_COUNTS`).
    """
    placed = (
        ((-38.0, 38.0), 1.9, (1.0, 0.97, 0.93)),
        ((42.0, 20.0), 1.35, (0.96, 0.98, 1.0)),
        ((3.0, 2.0), 1.15, (1.0, 1.0, 1.0)),
        ((-105.0, 30.0), 0.95, (1.0, 0.98, 0.96)),
        ((112.0, 45.0), 1.05, (0.97, 0.98, 1.0)),
    )
    made = []
    for (azimuth, elevation), strength, tint in placed:
        a, e = np.radians(azimuth), np.radians(elevation)
        direction = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        made.append(Light(direction, strength * np.array(tint)))
    return tuple(made)
