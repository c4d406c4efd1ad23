"""Identity directions: how people differ, as smooth fields over space, orthogonal and ordered by variance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ....bench.contracts import FloatArray
from ..geometry import smoothstep
from .anatomy import EYE_CENTER
from .expressions import principal_basis
from .surface import MIRROR, Surface

Field = Callable[[FloatArray], FloatArray]


def _along(axis: int, profile: Callable[[FloatArray], FloatArray]) -> Field:
    """Displacement along an axis, its size given by a profile of position (N, 3) -> (N,) metres."""

    def field(points: FloatArray) -> FloatArray:
        out = np.zeros_like(points)
        out[:, axis] = profile(points)
        return out

    return field


def _pair(
    center: tuple[float, ...], sigma: tuple[float, ...] | float, millimetres: tuple[float, ...]
) -> Field:
    """Gaussian pull around a point and its mirror image; the x component is outward on either side."""

    def field(points: FloatArray) -> FloatArray:
        out = np.zeros_like(points)
        for side in (np.ones(3), MIRROR):
            scaled = (points - side * center) / np.broadcast_to(sigma, 3)
            weight = np.exp(-0.5 * (scaled**2).sum(axis=1))
            out += weight[:, None] * side * np.array(millimetres) * (1e-3 if center[0] else 0.5e-3)
        return out

    return field


def _single(
    center: tuple[float, ...], sigma: tuple[float, ...] | float, millimetres: tuple[float, ...]
) -> Field:
    """Gaussian pull around one point: where faces are not symmetric."""

    def field(points: FloatArray) -> FloatArray:
        weight = np.exp(-0.5 * (((points - center) / np.broadcast_to(sigma, 3)) ** 2).sum(axis=1))
        return weight[:, None] * np.array(millimetres) * 1e-3

    return field


# One standard deviation of each trait; Farkas (1994) gives about 4-5 % for the large measures.
TRAITS: dict[str, Field] = {
    "size": lambda p: 0.030 * p,
    "breadth": _along(0, lambda p: 0.040 * p[:, 0]),
    "depth": _along(2, lambda p: 0.035 * p[:, 2]),
    "face_length": _along(
        1, lambda p: 0.060 * np.minimum(p[:, 1] - 0.02, 0) * smoothstep(p[:, 1], -0.22, -0.09)
    ),
    "skull_height": _along(1, lambda p: 0.060 * np.maximum(p[:, 1] - 0.04, 0)),
    "jaw_width": _pair((0.050, -0.060, 0.015), (0.022, 0.025, 0.030), (3.2, 0, 0)),
    "chin_forward": _pair((0, -0.086, 0.072), (0.022, 0.015, 0.024), (0, -0.5, 3.0)),
    "chin_height": _pair((0, -0.092, 0.066), (0.030, 0.014, 0.035), (0, -3.0, 0)),
    "chin_width": _pair((0.018, -0.086, 0.066), 0.012, (2.2, 0, 0)),
    "cheekbones": _pair((0.054, 0.000, 0.045), (0.016, 0.014, 0.022), (2.2, 0.3, 1.0)),
    "cheek_fullness": _pair((0.046, -0.036, 0.046), (0.018, 0.020, 0.022), (3.0, 0, 1.6)),
    "brow_ridge": _pair((0.020, 0.040, 0.073), (0.018, 0.009, 0.016), (0, 0, 1.8)),
    "brow_height": _pair((0.026, 0.040, 0.070), (0.020, 0.009, 0.018), (0, 1.8, 0)),
    "forehead_slope": _pair((0, 0.085, 0.060), (0.050, 0.026, 0.040), (0, 0, 3.2)),
    "temple": _pair((0.066, 0.040, 0.030), (0.020, 0.025, 0.028), (2.2, 0, 0)),
    "eye_spacing": _pair((0.0315, 0.020, 0.055), (0.014, 0.014, 0.025), (1.5, 0, 0)),
    "eye_depth": _pair((0.0315, 0.020, 0.055), (0.016, 0.014, 0.025), (0, 0, -1.3)),
    "nose_length": _pair((0, -0.022, 0.088), (0.016, 0.011, 0.018), (0, -2.2, 0.3)),
    "nose_projection": _pair((0, -0.017, 0.094), (0.014, 0.014, 0.018), (0, 0.3, 2.0)),
    "nose_width": _pair((0.0155, -0.021, 0.080), (0.008, 0.010, 0.012), (1.5, 0, 0)),
    "nose_bridge": _pair((0, 0.004, 0.076), (0.009, 0.011, 0.012), (0, 0, 1.6)),
    "nose_tip": _pair((0, -0.020, 0.096), 0.008, (0, 1.6, 0.3)),
    "mouth_width": _pair((0.0258, -0.052, 0.067), (0.012, 0.010, 0.016), (2.0, 0, -0.9)),
    "mouth_height": _pair((0, -0.051, 0.076), (0.030, 0.012, 0.025), (0, 1.6, 0)),
    "mouth_forward": _pair((0, -0.051, 0.078), (0.024, 0.016, 0.022), (0, 0, 1.6)),
    "lip_fullness": lambda p: _lip_fullness(p),
    "ear_flare": _pair((0.083, 0.014, -0.034), (0.013, 0.028, 0.014), (3.0, 0, 0.8)),
    "ear_size": _pair((0.078, 0.038, -0.028), (0.014, 0.016, 0.018), (0, 2.6, -0.5)),
    "neck_girth": lambda p: p * [0.07, 0, 0.07] * smoothstep(-p[:, 1], 0.070, 0.125)[:, None],
    "nose_aside": _single((0, -0.014, 0.090), (0.012, 0.016, 0.016), (1.0, 0, 0)),
    "jaw_aside": _single((0, -0.080, 0.060), (0.040, 0.024, 0.040), (1.6, 0, 0)),
    "brow_uneven": _single((0.028, 0.040, 0.070), (0.018, 0.010, 0.018), (0, 1.0, 0)),
}


def _lip_fullness(points: FloatArray) -> FloatArray:
    upper = _pair((0, -0.0455, 0.080), (0.014, 0.0042, 0.010), (0, 0.8, 1.0))(points)
    lower = _pair((0, -0.0580, 0.078), (0.013, 0.0045, 0.010), (0, -0.9, 1.1))(points)
    return upper + lower


def trait_field(name: str, points: FloatArray) -> FloatArray:
    """(N, 3) displacement, metres, by one deviation of a trait; each eye and its lids move as one."""
    field = TRAITS[name](points)
    for ball in (EYE_CENTER, EYE_CENTER * MIRROR):
        rigid = TRAITS[name](ball[None])[0]
        distance = np.linalg.norm(points - ball, axis=1)
        share = (1 - smoothstep(distance, 0.0175, 0.0300))[:, None]
        field = share * rigid + (1 - share) * field
    return field


def identity_basis(surface: Surface, seed: int) -> FloatArray:
    """(V, 3, S) orthogonal directions; coefficients drawn from N(0, 1) make plausible people."""
    fields = {name: trait_field(name, surface.vertices) for name in TRAITS}
    return principal_basis(fields, np.ones(len(fields)), seed).directions
