"""The sculpted surface at rest: skin and eyeballs, with what the rig asks of each vertex."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....bench.contracts import FloatArray, IntArray
from ....bench.io.arrays import Member, read_arrays
from ..geometry import vertex_normals
from .anatomy import EYE_CENTER, EYE_RADIUS, LID_CLEARANCE, MOUTH_CAVITY, slit_height

MIRROR = np.array([-1.0, 1.0, 1.0])
PACKAGED = Path(__file__).with_name("head.npz")
EYE_RINGS, EYE_SECTORS = 16, 24


@dataclass(frozen=True, eq=False)
class Surface:
    """Skin, left eyeball, right eyeball, in this order.

    Attributes
    ----------
    vertices : (V, 3) float64, metres.
    faces : (F, 3) int64, counter-clockwise seen from outside.
    mirror : (V,) vertex that is the mirror image of each.
    skin_count : number of skin vertices; each eyeball has half of the rest.
    """

    vertices: FloatArray
    faces: IntArray
    mirror: IntArray
    skin_count: int

    @cached_property
    def eyeballs(self) -> tuple[IntArray, IntArray]:
        """Vertices of the left and the right eyeball."""
        left, right = np.split(np.arange(self.skin_count, len(self.vertices)), 2)
        return left, right

    @cached_property
    def skin(self) -> FloatArray:
        """(V,) 1 on the skin, 0 on the eyeballs."""
        return (np.arange(len(self.vertices)) < self.skin_count).astype(float)

    @cached_property
    def in_mouth(self) -> NDArray[np.bool_]:
        """(V,) bool: on the wall of the mouth's cavity."""
        center, radii = (np.asarray(part) for part in MOUTH_CAVITY)
        inside = np.linalg.norm((self.vertices - center) / (radii + 0.0012), axis=1) < 1
        return inside & (self.skin > 0)

    @cached_property
    def in_socket(self) -> NDArray[np.bool_]:
        """(V,) bool: on the wall of the cavity behind a lid."""
        from_eye = np.linalg.norm(
            np.abs(self.vertices) * [1, 0, 0] + self.vertices * [0, 1, 1] - EYE_CENTER, axis=1
        )
        return (from_eye < EYE_RADIUS + LID_CLEARANCE + 0.0004) & (self.skin > 0)

    @cached_property
    def outside(self) -> NDArray[np.bool_]:
        """(V,) bool: skin that is seen from outside."""
        return (self.skin > 0) & ~self.in_mouth & ~self.in_socket

    @cached_property
    def above_slit(self) -> FloatArray:
        """(V,) height over the line between the lips, metres."""
        return self.vertices[:, 1] - slit_height(self.vertices[:, 0])

    @cached_property
    def normals(self) -> FloatArray:
        """(V, 3) unit normals, outward, weighted by area."""
        return vertex_normals(self.vertices, self.faces)

    def mirrored(self, field: FloatArray) -> FloatArray:
        """A displacement field (V, 3), or values (V,), reflected to the other side."""
        return field[self.mirror] * MIRROR if field.ndim == 2 else field[self.mirror]

    def nearest(self, point: FloatArray, among: IntArray | None = None) -> int:
        """Vertex nearest to a point, of those outside unless told otherwise."""
        candidates = np.flatnonzero(self.outside) if among is None else among
        return int(candidates[np.argmin(np.linalg.norm(self.vertices[candidates] - point, axis=1))])


def eyeball(rings: int = EYE_RINGS, sectors: int = EYE_SECTORS) -> tuple[FloatArray, IntArray]:
    """Unit sphere around the z axis, a pole in front: vertices (2 + (rings-1) sectors, 3) and triangles."""
    polar = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    around = np.linspace(0, 2 * np.pi, sectors, endpoint=False)[None]
    body = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around], -1
    )
    vertices = np.concatenate([[[0, 0, 1]], body.reshape(-1, 3), [[0, 0, -1]]])
    here = np.arange(sectors)
    after = (here + 1) % sectors
    last = len(vertices) - 1
    triangles = [np.column_stack([0 * here, 1 + here, 1 + after])]
    for ring in range(rings - 2):
        a, b = 1 + ring * sectors, 1 + (ring + 1) * sectors
        triangles += [np.column_stack([a + here, b + here, b + after])]
        triangles += [np.column_stack([a + here, b + after, a + after])]
    base = 1 + (rings - 2) * sectors
    triangles.append(np.column_stack([base + here, 0 * here + last, base + after]))
    return vertices, np.concatenate(triangles)


def assemble(skin: FloatArray, faces: IntArray, mirror: IntArray) -> Surface:
    """Add the eyeballs to the skin."""
    ball, triangles = eyeball()
    left = EYE_CENTER + EYE_RADIUS * ball
    right = left * MIRROR
    start, size = len(skin), len(ball)
    return Surface(
        vertices=np.concatenate([skin, left, right]),
        faces=np.concatenate([faces, start + triangles, start + size + triangles[:, ::-1]]).astype(np.int64),
        mirror=np.concatenate([mirror, start + size + np.arange(size), start + np.arange(size)]),
        skin_count=start,
    )


def load_surface(path: Path = PACKAGED) -> Surface:
    """The surface that `sculpt` wrote: the packaged one, or the one at ``path``.

    Raises
    ------
    InputError
        Where the file is no such npz.
    """
    members = {
        "vertices": Member("f", ("V", 3)),
        "faces": Member("iu", ("F", 3)),
        "mirror": Member("iu", ("V",)),
    }
    stored = read_arrays(path, members)
    vertices, faces, mirror = (stored[name] for name in members)
    return assemble(vertices.astype(np.float64), faces.astype(np.int64), mirror.astype(np.int64))
