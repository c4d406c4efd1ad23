"""Signed distance to a tracked mesh that need not be closed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from ...bench.contracts import FloatArray, IntArray
from ...datasets.head.geometry import vertex_normals

INNER_PARTS = ("teeth", "mouth_socket")
"""Regions behind the skin: what lies about them says nothing of inside and outside."""

FACING, FORWARD = ("left_eyeball", "right_eyeball", "eye_region"), 0.3
"""Regions that bound the head by what faces forward of them (least component of the normals along z): eyeballs fill the
lids' opening, but their backs, and the inner sides of lids, lie behind the skin."""


class TangentDistance:
    """Distance to the nearest vertex, signed by the side of its tangent plane that a point is on; positive outside.

    Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992, section 3.3. Where a mesh ends (the
    neck's lower edge) its walls continue, which is what a bust wants.

    Parameters
    ----------
    vertices : (V, 3).
    faces : (F, 3), counter-clockwise seen from outside.
    keep : (K,) vertices that count.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray, keep: IntArray):
        normals = vertex_normals(np.asarray(vertices, np.float64), np.asarray(faces))
        self._points, self._normals = np.asarray(vertices, np.float64)[keep], normals[keep]
        self._tree = cKDTree(self._points)

    def __call__(self, places: FloatArray) -> FloatArray:
        """(N,) distances of (N, 3) places."""
        distance, nearest = self._tree.query(places)
        side = np.einsum("ni,ni->n", places - self._points[nearest], self._normals[nearest])
        return np.where(side < 0, -distance, distance)


def outer_vertices(vertices: FloatArray, faces: IntArray, regions: Mapping[str, IntArray]) -> IntArray:
    """(K,) vertices of an unposed head that bound it: all but `INNER_PARTS` and what does not face forward of
    `FACING`."""
    bounding = np.ones(len(vertices), bool)
    for name in INNER_PARTS:
        bounding[regions.get(name, [])] = False
    forward = vertex_normals(vertices, faces)[:, 2] > FORWARD
    for name in FACING:
        rows = np.asarray(regions.get(name, []), np.int64)
        bounding[rows] = forward[rows]
    return np.flatnonzero(bounding)
