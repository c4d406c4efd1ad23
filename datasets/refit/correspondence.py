"""Points of one surface on another: closest points with barycentric weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from ...bench.contracts import FloatArray, IntArray

_FIRST_CANDIDATES = 16


class ClosestPoints(NamedTuple):
    """Where n points meet a surface."""

    face: IntArray
    """(n,) triangle."""
    weights: FloatArray
    """(n, 3) barycentric weights of its corners, non-negative, rows sum to 1."""
    distance: FloatArray
    """(n,) in the unit of the points."""

    def matrix(self, faces: IntArray, vertex_count: int, rows: IntArray, row_count: int) -> csr_array:
        """(row_count, V) sparse matrix whose ``rows`` (n,) take vertices of the surface to the closest points."""
        entries = (np.repeat(rows, 3), faces[self.face].ravel())
        return csr_array((self.weights.ravel(), entries), shape=(row_count, vertex_count))


def closest_points(points: FloatArray, vertices: FloatArray, faces: IntArray) -> ClosestPoints:
    """Exact closest points on a triangle mesh; degenerate triangles count as segments or points.

    Triangles are tried in the order of their centres' distance until no further one can be nearer: none whose
    centre is farther than the best distance plus the largest distance from a centre to a corner.
    """
    corners = vertices[faces]
    centres = corners.mean(axis=1)
    reach = float(np.linalg.norm(corners - centres[:, None], axis=2).max())
    tree = cKDTree(centres)
    face = np.zeros(len(points), dtype=np.int64)
    weights = np.zeros((len(points), 3))
    distance = np.zeros(len(points))
    open_points, tried = np.arange(len(points)), min(_FIRST_CANDIDATES, len(faces))
    while len(open_points):
        away, candidates = tree.query(points[open_points], k=tried)
        away, candidates = away.reshape(-1, tried), candidates.reshape(-1, tried)
        barycentric = _on_triangles(points[open_points, None], corners[candidates])
        nearest = np.einsum("nkc,nkci->nki", barycentric, corners[candidates])
        gaps = np.linalg.norm(points[open_points, None] - nearest, axis=2)
        best = gaps.argmin(axis=1)
        rows = np.arange(len(open_points))
        face[open_points] = candidates[rows, best]
        weights[open_points] = barycentric[rows, best]
        distance[open_points] = gaps[rows, best]
        unsure = away[:, -1] < gaps[rows, best] + reach
        if tried == len(faces):
            break
        open_points, tried = open_points[unsure], min(4 * tried, len(faces))
    return ClosestPoints(face, weights, distance)


def _on_triangles(points: FloatArray, corners: FloatArray) -> FloatArray:
    """(..., 3) barycentric weights of the points of triangles (..., 3, 3) closest to points (..., 3).

    The foot in the plane if it is inside, else the nearest of the closest points on the three edges.
    """
    a, b, c = np.moveaxis(corners, -2, 0)
    ab, ac, ap = b - a, c - a, points - a
    aa, cc, cross = (ab * ab).sum(-1), (ac * ac).sum(-1), (ab * ac).sum(-1)
    pa, pc = (ap * ab).sum(-1), (ap * ac).sum(-1)
    area = aa * cc - cross * cross
    flat = area <= 1e-14 * (aa * cc)
    safe = np.where(flat, 1.0, area)
    v, w = (cc * pa - cross * pc) / safe, (aa * pc - cross * pa) / safe
    inside = ~flat & (v >= 0) & (w >= 0) & (v + w <= 1)
    result = np.stack([1 - v - w, v, w], axis=-1)
    nearest = np.full(inside.shape, np.inf)
    for start, stop in ((0, 1), (1, 2), (2, 0)):
        edge = corners[..., stop, :] - corners[..., start, :]
        length = (edge * edge).sum(-1)
        along = ((points - corners[..., start, :]) * edge).sum(-1) / np.where(length > 0, length, 1.0)
        along = np.clip(along, 0.0, 1.0)
        foot = corners[..., start, :] + along[..., None] * edge
        gap = np.square(points - foot).sum(-1)
        nearer = ~inside & (gap < nearest)
        nearest = np.where(nearer, gap, nearest)
        on_edge = np.zeros_like(result)
        on_edge[..., start], on_edge[..., stop] = 1 - along, along
        result = np.where(nearer[..., None], on_edge, result)
    return result
