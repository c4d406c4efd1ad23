"""Hair on the head: a hairline, a thick cap under it, and combed ribbons over the cap.

The cap is the scalp itself pushed outwards, so that no skin shows between the ribbons and the matte stays
whole; the ribbons give strands, shine and a soft outline. Both move with the head.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...bench.contracts import FloatArray, IntArray
from .anatomy import SIDES, Anatomy
from .curves import ramp
from .noise import fractal_noise, value_noise
from .people import Person
from .strands import Strands, grow, ribbons


@dataclass(frozen=True)
class Style:
    """A way to wear hair; lengths in metres.

    ``fall`` is the pull downwards (0 keeps hair on the skull), ``sweep`` the pull to the side of the parting,
    ``back`` the pull backwards, ``curl`` the amplitude of waves relative to the growth direction.
    """

    length: float
    cap: float
    strands: int
    width: float
    fall: float
    sweep: float
    back: float
    curl: float
    parting: float


STYLES = {
    "crop": Style(0.012, 0.0035, 6500, 0.0010, 0.05, 0.10, -0.30, 0.35, 0.0),
    "short": Style(0.045, 0.0100, 6000, 0.0013, 0.25, 0.80, 0.35, 0.30, 0.025),
    "bob": Style(0.170, 0.0110, 4200, 0.0017, 1.10, 0.55, 0.45, 0.22, -0.018),
    "long": Style(0.270, 0.0110, 4500, 0.0018, 1.20, 0.50, 0.55, 0.40, 0.012),
}

# Hairline: height above the brows (m) by azimuth from the front (degrees), for a head of average size.
_AZIMUTH = np.radians([0.0, 25.0, 42.0, 54.0, 63.0, 74.0, 84.0, 100.0, 118.0, 180.0])
_HEIGHT = np.array([0.060, 0.058, 0.050, 0.024, -0.008, -0.036, -0.026, -0.052, -0.085, -0.098])


@dataclass(frozen=True, eq=False)
class Hair:
    """``cap`` (N,) thickness over the fine skin points in metres, ``share`` (N,) coverage, and ribbons."""

    cap: FloatArray
    share: FloatArray
    strands: Strands


def hair_share(person: Person, anatomy: Anatomy, points: FloatArray, ears: FloatArray) -> FloatArray:
    """Coverage of the skin by hair roots, (N,); ``ears`` (N,) is 1 on the ears."""
    s = anatomy.scale
    middle_z = 0.5 * (anatomy["glabella"][2] + anatomy["vertex_top"][2]) - 0.045 * s
    azimuth = np.arctan2(np.abs(points[:, 0]), points[:, 2] - middle_z)
    line = anatomy["glabella"][1] + s * np.interp(azimuth, _AZIMUTH, _HEIGHT)
    ragged = 0.0035 * s * fractal_noise(points, 0.012 * s, person.seed + 80, 3)
    return ramp(points[:, 1] - line + ragged, -0.002 * s, 0.009 * s) * (1.0 - ears)


def make_hair(
    person: Person,
    anatomy: Anatomy,
    points: FloatArray,
    normals: FloatArray,
    faces: IntArray,
    ears: FloatArray,
) -> Hair:
    """Grow the subject's hair on the neutral fine skin."""
    style, s = STYLES[person.style], anatomy.scale
    share = hair_share(person, anatomy, points, ears)
    uneven = 1.0 + 0.35 * fractal_noise(points, 0.03 * s, person.seed + 81, 2)
    cap = style.cap * s * share * uneven
    rng = np.random.default_rng(person.seed + 82)
    chosen = _sample(points, faces, share, style.strands, rng)
    weights = rng.dirichlet(np.ones(3), len(chosen))
    surface = points + cap[:, None] * normals
    roots = np.einsum("nk,nki->ni", weights, surface[faces[chosen]])
    lengths = style.length * s * rng.uniform(0.7, 1.15, len(roots))
    # Hair close to the hairline is shorter on short heads; long hair keeps its length.
    edge = np.einsum("nk,nk->n", weights, share[faces[chosen]])
    lengths *= 0.45 + 0.55 * edge if style.length < 0.1 else 1.0
    tree, surface_normals = cKDTree(surface), normals

    def keep_out(place: FloatArray, along: float) -> FloatArray:
        _, nearest = tree.query(place, k=4)
        normal = surface_normals[nearest].mean(axis=1)
        height = np.einsum("ni,ni->n", place - surface[nearest].mean(axis=1), normal)
        wanted = (0.0006 + 0.0024 * along) * s
        return place + np.maximum(wanted - height, 0.0)[:, None] * normal

    parting = style.parting * s + anatomy["vertex_top"][0]
    phase = rng.integers(0, 3, len(roots)) * 31.7

    def field(place: FloatArray, along: float) -> FloatArray:
        _, nearest = tree.query(place)
        normal = surface_normals[nearest]
        side = np.tanh((place[:, 0] - parting) / (0.02 * s))
        top = ramp(normal[:, 1], 0.2, 0.8)
        front = ramp(place[:, 2], anatomy["vertex_top"][2], anatomy["glabella"][2])
        wish = np.stack(
            [style.sweep * side * (0.4 + 0.6 * top), np.full(len(place), -style.fall), -style.back * (0.3 + 0.7 * front)],
            axis=1,
        )
        # Away from the crown, down the skull.
        crown = anatomy["vertex_top"] + np.array([0.0, 0.0, -0.03]) * s
        away = place - crown
        wish += 0.45 * away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        tangent = wish - np.einsum("ni,ni->n", wish, normal)[:, None] * normal
        wave = [value_noise(place / (0.02 * s) + phase[:, None] + 7.0 * axis, person.seed + 83) for axis in range(3)]
        lift = 0.25 * (1.0 - along) * normal
        free = ramp(place[:, 1], anatomy["mouth"][1] + 0.02 * s, anatomy["mouth"][1] - 0.02 * s)[:, None]
        hang = np.array([0.0, -style.fall, -0.12])
        return tangent * (1.0 - 0.6 * free) + free * hang + lift + style.curl * np.stack(wave, axis=1)

    segments = int(np.clip(round(style.length / 0.014), 4, 14))
    paths = grow(roots, lengths, field, keep_out, segments)
    _, nearest = tree.query(paths[:, segments // 2])
    roll = rng.normal(0.0, 0.35, (len(roots), 1, 3))
    clump = 0.5 * fractal_noise(roots, 0.016 * s, person.seed + 84, 2) + 0.22 * rng.standard_normal(len(roots))
    color = person.hair[None] * np.exp(0.75 * clump)[:, None]
    width = style.width * s * rng.uniform(0.7, 1.3, len(roots))
    return Hair(cap, share, ribbons(paths, normals[nearest][:, None] + roll, width, color, 1.35))


def ear_share(anatomy: Anatomy, points: FloatArray, labelled: IntArray | None) -> FloatArray:
    """1 on the ears, 0 elsewhere, (N,): from labelled fine points where the head names its ears."""
    if labelled is not None:
        share = np.zeros(len(points))
        share[labelled] = 1.0
        return share
    s, total = anatomy.scale, np.zeros(len(points))
    for side in SIDES:
        middle = anatomy[f"{side}_ear"] * np.array([0.93, 1.0, 1.0]) + np.array([0.0, -0.008, 0.008]) * s
        distance = np.sqrt(((((points - middle) / s) / np.array([0.018, 0.034, 0.024])) ** 2).sum(axis=1))
        total = np.maximum(total, ramp(distance, 1.15, 0.9))
    return total


def _sample(
    points: FloatArray, faces: IntArray, share: FloatArray, count: int, rng: np.random.Generator
) -> IntArray:
    """Draw triangles by area times coverage."""
    corner = points[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    chance = area * np.where(share[faces].mean(axis=1) > 0.15, 0.25 + 0.75 * share[faces].mean(axis=1), 0.0)
    return rng.choice(len(faces), count, p=chance / chance.sum())
