"""The skin's colour at rest, painted once per subject on the fine mesh.

Painting is a function of the neutral shape and the subject's traits alone; what expressions add is in
`wrinkles`. Colours are linear-light reflectances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray
from ..head.geometry import smoothstep
from .anatomy import SIDES, Anatomy
from .curves import blob, polygon_distance, polyline_distance, smooth_curve
from .noise import fractal_noise, spots, value_noise
from .people import Person

_FRONT = 0.35  # z component of the normal from which on a point counts as facing front


@dataclass(frozen=True, eq=False)
class SkinPaint:
    """(N, 3) reflectance, and the (N,) share of the lips' red, which folds and flushes need."""

    albedo: FloatArray
    lips: FloatArray


def paint_skin(
    person: Person, anatomy: Anatomy, points: FloatArray, normals: FloatArray, cavity: FloatArray
) -> SkinPaint:
    """Paint the fine skin points (N, 3) of a neutral subject.

    ``normals`` (N, 3) point outwards; ``cavity`` (N,) is the share of each point in the mouth's wall.
    """
    s, seed = anatomy.scale, person.seed
    color = np.tile(person.skin, (len(points), 1))
    red = person.skin * np.array([1.02, 0.66, 0.62])
    color = _mix(color, red, 0.55 * _flush(anatomy, points))
    color = _mix(color, person.skin * np.array([0.62, 0.52, 0.55]), 0.55 * _around_eyes(anatomy, points))
    # Blotches, then pores: real skin is never even.
    color *= (1.0 + 0.10 * fractal_noise(points, 0.03 * s, seed, 3))[:, None]
    color[:, 1:] *= (1.0 - 0.06 * fractal_noise(points, 0.012 * s, seed + 7, 3))[:, None]
    color *= (1.0 + 0.05 * value_noise(points / (0.0014 * s), seed + 8))[:, None]
    facing = smoothstep(normals[:, 2], 0.0, _FRONT)
    color = _mix(
        color, person.skin * np.array([0.62, 0.44, 0.34]), person.freckles * _freckles(anatomy, points, seed)
    )
    moles = spots(points, 0.045 * s, 0.0016 * s, 0.25, seed + 31)
    color = _mix(color, person.skin * np.array([0.22, 0.14, 0.12]), moles)
    beard = person.hair * 0.6 + person.skin * np.array([0.10, 0.12, 0.13])
    color = _mix(color, beard, 0.55 * person.stubble * _beard(anatomy, points, seed))
    lips = lip_share(anatomy, points) * facing
    stripes = 1.0 + 0.10 * value_noise(points / (np.array([0.0012, 0.02, 0.02]) * s), seed + 40)
    color = _mix(color, person.lips[None] * stripes[:, None], 0.92 * lips)
    color = _mix(color, np.array([0.055, 0.012, 0.012]), cavity)
    color = _mix(color, person.skin * np.array([0.10, 0.05, 0.05]), 0.9 * _nostrils(anatomy, points, normals))
    lid = _lid_lines(anatomy, points)
    color = _mix(color, np.minimum(person.hair, 0.02) + np.array([0.012, 0.006, 0.005]), lid)
    brows = brow_share(person, anatomy, points) * facing
    color = _mix(color, brow_color(person), 0.85 * brows)
    return SkinPaint(np.clip(color, 0.004, 0.95), lips)


def brow_color(person: Person) -> FloatArray:
    """Brows are darker than hair, and never as light as skin."""
    return np.minimum(0.55 * person.hair, 0.35 * person.skin)


def brow_curve(anatomy: Anatomy, side: str, count: int = 24) -> FloatArray:
    """(count, 3) middle line of a brow from the nose outwards."""
    anchors = np.stack([anatomy[f"{side}_brow_{place}"] for place in ("inner", "mid", "outer")])
    return smooth_curve(anchors, count)


def brow_share(person: Person, anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """Coverage by brow hair, (N,) in [0, 1]: full near the nose, tapering outwards, with strands."""
    total = np.zeros(len(points))
    for side in SIDES:
        curve = brow_curve(anatomy, side)
        distance, place = polyline_distance(points, curve)
        half = 0.0042 * anatomy.scale * person.brow_thickness * (1.0 - 0.75 * place**2)
        strands = value_noise(points / (np.array([0.0022, 0.0013, 0.0022]) * anatomy.scale), person.seed + 50)
        edge = distance / half + 0.28 * strands
        total = np.maximum(total, smoothstep(edge, 1.15, 0.55) * (0.80 + 0.2 * strands))
    return np.clip(total, 0.0, 1.0)


def lip_share(anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """How much a point belongs to the red of the lips, by the outline seen from the front."""
    s, outline = anatomy.scale, anatomy.lip_outline
    near = _near(points, anatomy["mouth"], 0.06 * s)
    share = np.zeros(len(points))
    share[near] = smoothstep(polygon_distance(points[near, :2], outline[:, :2]), 0.0006 * s, -0.0010 * s)
    return share * (points[:, 2] > outline[:, 2].min() - 0.008 * s)


def _mix(color: FloatArray, other: FloatArray, share: FloatArray) -> FloatArray:
    return color + share[:, None] * (other - color)


def _near(points: FloatArray, center: FloatArray, radius: float) -> FloatArray:
    return np.linalg.norm(points - center, axis=1) < radius


def _flush(anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """Where blood shows: cheeks, nose, ears, chin."""
    s = anatomy.scale
    total = 0.9 * blob(points, anatomy["nose_tip"], 0.011 * s) + 0.35 * blob(
        points, anatomy["chin"], 0.014 * s
    )
    for side in SIDES:
        total += 0.75 * blob(points, anatomy[f"{side}_cheek"], 0.019 * s)
        total += 0.55 * blob(points, anatomy[f"{side}_ala"], 0.007 * s)
        total += 0.8 * blob(points, anatomy[f"{side}_ear"], 0.022 * s)
    return np.minimum(total, 1.0)


def _around_eyes(anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """Shade of the sockets: the upper lid and crease, the inner corner, the bag below."""
    s, total = anatomy.scale, np.zeros(len(points))
    for side in SIDES:
        eye = anatomy.eyes[side]
        near = _near(points, np.append(eye.outline.mean(axis=0), eye.center[2] + eye.radius), 0.045 * s)
        flat = points[near, :2]
        crease, _ = polyline_distance(flat, eye.upper + np.array([0.0, 0.0055 * s]))
        bag, _ = polyline_distance(flat, eye.lower - np.array([0.0, 0.0060 * s]))
        share = 0.75 * np.exp(-0.5 * (crease / (0.0032 * s)) ** 2) + 0.38 * np.exp(
            -0.5 * (bag / (0.004 * s)) ** 2
        )
        inner = np.linalg.norm(flat - eye.upper[0], axis=1)
        total[near] = np.maximum(total[near], share + 0.5 * np.exp(-0.5 * (inner / (0.006 * s)) ** 2))
    return np.minimum(total, 1.0)


def _lid_lines(anatomy: Anatomy, points: FloatArray) -> FloatArray:
    """The roots of the lashes: a dark line along both lids, strongest on the upper."""
    s, total = anatomy.scale, np.zeros(len(points))
    for side in SIDES:
        eye = anatomy.eyes[side]
        near = _near(points, np.append(eye.outline.mean(axis=0), eye.center[2] + eye.radius), 0.03 * s)
        for curve, width, strength in ((eye.upper, 0.0011, 0.95), (eye.lower, 0.0007, 0.55)):
            distance, place = polyline_distance(points[near, :2], curve)
            share = (
                strength
                * np.exp(-0.5 * (distance / (width * s)) ** 2)
                * (0.45 + 0.55 * smoothstep(place, 0.05, 0.5))
            )
            total[near] = np.maximum(total[near], share)
    return total


def _nostrils(anatomy: Anatomy, points: FloatArray, normals: FloatArray) -> FloatArray:
    """The two dark openings under the nose's tip."""
    s, total = anatomy.scale, np.zeros(len(points))
    for sign in (1.0, -1.0):
        middle = anatomy["nose_base"] + np.array([sign * 0.0068, 0.0025, 0.0]) * s
        total += blob(points, middle, np.array([0.0034, 0.0030, 0.0055]) * s)
    return np.minimum(1.6 * total, 1.0) * smoothstep(-normals[:, 1], 0.1, 0.55)


def _freckles(anatomy: Anatomy, points: FloatArray, seed: int) -> FloatArray:
    s = anatomy.scale
    where = sum(blob(points, anatomy[f"{side}_cheek"], 0.026 * s) for side in SIDES)
    where = np.minimum(where + blob(points, anatomy["nose_bridge"], 0.022 * s), 1.0)
    return 0.8 * where * spots(points, 0.0042 * s, 0.0013 * s, 0.55, seed + 21)


def _beard(anatomy: Anatomy, points: FloatArray, seed: int) -> FloatArray:
    """Where a beard would grow, grained as stubble."""
    s = anatomy.scale
    mouth, chin = anatomy["mouth"], anatomy["chin"]
    low = smoothstep(points[:, 1], mouth[1] + 0.018 * s, mouth[1] - 0.006 * s) * smoothstep(
        points[:, 1], chin[1] - 0.03 * s, chin[1]
    )
    front = smoothstep(points[:, 2], anatomy["left_ear"][2] + 0.012 * s, anatomy["left_ear"][2] + 0.035 * s)
    cheeks = sum(blob(points, anatomy[f"{side}_cheek"], np.array([0.02, 0.026, 0.03]) * s) for side in SIDES)
    grain = 0.75 + 0.35 * value_noise(points / (0.0016 * s), seed + 60)
    return np.clip(low * front * (1.0 - 0.9 * np.minimum(cheeks, 1.0)) * grain, 0.0, 1.0)
