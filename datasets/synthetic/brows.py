"""Brows and lashes: short ribbons rooted in the skin, moving with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...bench.contracts import FloatArray, IntArray
from .anatomy import SIDES, Anatomy, Eye
from .people import Person
from .skin import brow_color, brow_curve
from .strands import Strands, ribbons

_BROW_HAIRS = 260
_UPPER_LASHES, _LOWER_LASHES = 70, 40


@dataclass(frozen=True, eq=False)
class RootedStrands:
    """Ribbons at rest and the fine skin point (n,) that each grows from."""

    strands: Strands
    root: IntArray


def make_brows_and_lashes(
    person: Person, anatomy: Anatomy, points: FloatArray, normals: FloatArray
) -> RootedStrands:
    """Both brows and all four rows of lashes of a neutral subject."""
    rng = np.random.default_rng(person.seed + 70)
    tree, made, roots = cKDTree(points), None, []
    for side, sign in zip(SIDES, (1.0, -1.0)):
        for paths, width, color in (
            _brow(person, anatomy, side, sign, rng, points, normals, tree),
            *_lashes(person, anatomy, anatomy.eyes[side], sign, rng, points, tree),
        ):
            _, root = tree.query(paths[:, 0])
            shades = color[None] * np.exp(0.2 * rng.standard_normal((len(paths), 1)))
            facing = normals[root][:, None] + rng.normal(0.0, 0.3, (len(paths), 1, 3))
            widths = np.full(len(paths), width * anatomy.scale)
            strands = ribbons(paths, facing, widths, np.repeat(shades[:, None], 2, axis=1))
            made = strands if made is None else made.joined(strands)
            roots.append(root)
    assert made is not None
    return RootedStrands(made, np.concatenate(roots))


def _brow(
    person: Person,
    anatomy: Anatomy,
    side: str,
    sign: float,
    rng: np.random.Generator,
    points: FloatArray,
    normals: FloatArray,
    tree: cKDTree,
) -> tuple[FloatArray, float, FloatArray]:
    """Hairs that start along the brow's curve, rise near the nose and lie down outwards."""
    s = anatomy.scale
    curve = brow_curve(anatomy, side, 64)
    place = rng.uniform(0.0, 0.95, _BROW_HAIRS)
    half = 0.0034 * s * person.brow_thickness * (1.0 - 0.75 * place**2)
    at = np.stack([np.interp(place, np.linspace(0, 1, 64), curve[:, axis]) for axis in range(3)], axis=1)
    at[:, 1] += half * rng.uniform(-1.0, 0.8, _BROW_HAIRS)
    _, root = tree.query(at)
    start, normal = points[root], normals[root]
    lean = np.stack([sign * (0.45 + 0.9 * place), 0.85 - 1.25 * place, -0.25 * place], axis=1)
    lean += 0.18 * rng.standard_normal(lean.shape)
    lean -= np.einsum("ni,ni->n", lean, normal)[:, None] * normal
    lean /= np.linalg.norm(lean, axis=1, keepdims=True)
    length = 0.0068 * s * rng.uniform(0.6, 1.1, _BROW_HAIRS)
    t = np.linspace(0.0, 1.0, 4)[None, :, None]
    rise = (0.0002 + 0.0009 * t * (1.0 - 0.5 * t)) * s
    paths = start[:, None] + t * length[:, None, None] * lean[:, None] + rise * normal[:, None]
    return paths, 0.00055, brow_color(person)


def _lashes(
    person: Person,
    anatomy: Anatomy,
    eye: Eye,
    sign: float,
    rng: np.random.Generator,
    points: FloatArray,
    tree: cKDTree,
) -> list[tuple[FloatArray, float, FloatArray]]:
    """Upper lashes curve up and outwards, lower ones down and are shorter and thinner."""
    s, made = anatomy.scale, []
    color = np.minimum(0.4 * person.hair, 0.03)
    for curve, up, count, reach in (
        (eye.upper, 1.0, _UPPER_LASHES, 0.0070),
        (eye.lower, -1.0, _LOWER_LASHES, 0.0038),
    ):
        place = np.sort(rng.uniform(0.12, 0.98, count))
        flat = np.stack(
            [np.interp(place, np.linspace(0, 1, len(curve)), curve[:, axis]) for axis in (0, 1)], 1
        )
        depth = eye.radius**2 - ((flat - eye.center[:2]) ** 2).sum(axis=1)
        z = eye.center[2] + np.sqrt(np.maximum(depth, 0.0)) + 0.0006 * s
        _, root = tree.query(np.concatenate([flat, z[:, None]], axis=1))
        start = points[root]
        outwards = np.stack([sign * 1.1 * (place - 0.35), np.zeros(count), np.ones(count)], axis=1)
        outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
        length = reach * s * (0.55 + 0.45 * place) * rng.uniform(0.8, 1.1, count)
        t = np.linspace(0.0, 1.0, 4)[None, :, None]
        rise = np.array([0.0, up, 0.0])
        paths = start[:, None] + length[:, None, None] * (
            0.85 * t * outwards[:, None] + (0.1 * t + 0.75 * t**2) * rise
        )
        made.append((paths, 0.00042 if up > 0 else 0.0003, color))
    return made
