"""Spectacle frames, which are not in the tracked mesh. They follow the head joint; clear lenses are not modelled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...bench.contracts import FloatArray, IntArray
from .anatomy import SIDES, Anatomy, Person, linear
from .fields import smooth_curve

_SIDES_OF_TUBE = 8
_WRAP = 3.0  # 1/m: how the front bends around the face
_ROOM = 0.002  # metres between skin and frame
_COLORS = {
    "metal": ("#8a8a8c", "#b3975f", "#3a3a3c"),
    "plastic": ("#1c1a19", "#5a3420", "#25324a", "#6b1f24"),
}
_RADIUS = {"metal": 0.0009, "plastic": 0.0014}


@dataclass(frozen=True, eq=False)
class GlassesFrame:
    """(n, 3) vertices at rest, (m, 3) triangles, (n, 3) linear reflectance."""

    vertices: FloatArray
    faces: IntArray
    albedo: FloatArray


def make_glasses(
    person: Person, anatomy: Anatomy, points: FloatArray, normals: FloatArray
) -> GlassesFrame | None:
    """A frame that sits on the neutral skin (N, 3), or none."""
    if not person.glasses:
        return None
    s, rng = anatomy.scale, np.random.default_rng([person.seed, 17])
    radius = _RADIUS[person.glasses] * s
    half = np.array([0.0245, 0.0195]) * s * rng.uniform(0.92, 1.06, 2)
    roundness = rng.uniform(2.2, 3.6)
    color = linear(_COLORS[person.glasses][rng.integers(len(_COLORS[person.glasses]))])
    turn = np.linspace(0.0, 2.0 * np.pi, 56, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    ring = half * np.sign(ring) * np.abs(ring) ** (2.0 / roundness)
    level = 0.5 * sum(anatomy.eyes[side].center[1] for side in SIDES) - 0.002 * s
    lens = 0.0345 * s
    outlines = {side: ring + np.array([sign * lens, level]) for side, sign in zip(SIDES, (1.0, -1.0))}
    front = points[normals[:, 2] > 0.2]
    flat = cKDTree(front[:, :2])
    depth = max(
        front[near, 2].max() + _WRAP / s * at[0] ** 2
        for outline in outlines.values()
        for at, near in zip(outline, flat.query_ball_point(outline, 0.003 * s))
        if near
    ) + (_ROOM * s + radius)

    def placed(at: FloatArray) -> FloatArray:
        return np.concatenate([at, (depth - _WRAP / s * at[:, :1] ** 2)], axis=1)

    tubes = [_tube(placed(outline), radius, np.array([0.0, 0.0, 1.0]), True) for outline in outlines.values()]
    inner = lens - half[0]
    x = np.linspace(-inner, inner, 11)
    bridge = placed(np.stack([x, level + 0.004 * s + 0.004 * s * (1.0 - (x / inner) ** 2)], axis=1))
    bridge[:, 2] = np.maximum(bridge[:, 2], anatomy["nose_bridge"][2] + _ROOM * s + radius)
    tubes.append(_tube(bridge, radius, np.array([0.0, 1.0, 0.0]), False))
    skin = cKDTree(points)
    for side, sign in zip(SIDES, (1.0, -1.0)):
        ear = anatomy[f"{side}_ear"]
        hinge = placed(np.array([[sign * (lens + 0.96 * half[0]), level + 0.45 * half[1]]]))[0]
        wide = sign * max(abs(ear[0]) - 0.008 * s, abs(hinge[0]) + 0.004 * s)
        temple = smooth_curve(
            np.stack(
                [
                    hinge,
                    np.array([0.35 * hinge[0] + 0.65 * wide, hinge[1], hinge[2] - 0.016 * s]),
                    np.array([wide, 0.5 * (hinge[1] + ear[1] + 0.026 * s), 0.5 * (hinge[2] + ear[2])]),
                    np.array([wide, ear[1] + 0.026 * s, ear[2] + 0.006 * s]),
                    np.array([wide - sign * 0.006 * s, ear[1] + 0.008 * s, ear[2] - 0.014 * s]),
                ]
            ),
            28,
        )
        _, near = skin.query(temple)
        below = _ROOM * s + radius - ((temple - points[near]) * normals[near]).sum(axis=1)
        temple[1:-4] += (np.maximum(below, 0.0)[:, None] * normals[near])[1:-4]
        tubes.append(_tube(temple, radius, np.array([0.0, 1.0, 0.0]), False))
    first = np.cumsum([0, *(len(vertices) for vertices, _ in tubes)])
    vertices = np.concatenate([vertices for vertices, _ in tubes])
    faces = np.concatenate([faces + start for (_, faces), start in zip(tubes, first)])
    return GlassesFrame(vertices, faces, np.tile(color, (len(vertices), 1)))


def _tube(path: FloatArray, radius: float, up: FloatArray, closed: bool) -> tuple[FloatArray, IntArray]:
    """A tube along (k, 3); ``up`` is never along it."""
    along = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0) if closed else np.gradient(path, axis=0)
    across = np.cross(along, up)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upright = np.cross(across, along)
    upright /= np.linalg.norm(upright, axis=1, keepdims=True)
    turn = np.linspace(0.0, 2.0 * np.pi, _SIDES_OF_TUBE, endpoint=False)
    ring = np.cos(turn)[None, :, None] * across[:, None] + np.sin(turn)[None, :, None] * upright[:, None]
    index = np.arange(len(path) * _SIDES_OF_TUBE).reshape(len(path), _SIDES_OF_TUBE)
    a, b = (index, np.roll(index, -1, axis=0)) if closed else (index[:-1], index[1:])
    a1, b1 = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.concatenate(
        [np.stack([a, a1, b1], -1).reshape(-1, 3), np.stack([a, b1, b], -1).reshape(-1, 3)]
    )
    return (path[:, None] + radius * ring).reshape(-1, 3), faces
