"""Points of one surface on another: closest points with barycentric weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from ....bench.contracts import FloatArray, IntArray

_FIRST_CANDIDATES = 12


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

    Triangles of like size are searched together, those of the smallest last: in the order of their centres'
    distance, until the next centre is farther than the best distance so far plus the largest distance from a
    centre to a corner among them.
    """
    corners = vertices[faces]
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    size = np.floor(np.log2(np.maximum(radii, 1e-3 * radii.max() + np.finfo(float).tiny))).astype(np.int64)
    found = ClosestPoints(
        np.zeros(len(points), dtype=np.int64), np.zeros((len(points), 3)), np.full(len(points), np.inf)
    )
    for alike in np.unique(size)[::-1]:
        members = np.flatnonzero(size == alike)
        _search(points, corners[members], centres[members], float(radii[members].max()), members, found)
    return found


def _search(
    points: FloatArray,
    corners: FloatArray,
    centres: FloatArray,
    reach: float,
    names: IntArray,
    found: ClosestPoints,
) -> None:
    """Enter into ``found`` what is nearer than what it holds."""
    tree = cKDTree(centres)
    rest, tried = np.arange(len(points)), min(_FIRST_CANDIDATES, len(centres))
    while len(rest):
        away, candidates = tree.query(points[rest], k=tried)
        away, candidates = away.reshape(-1, tried), candidates.reshape(-1, tried)
        # Most candidates are too far to matter: only those that may be nearest are measured.
        row, column = np.nonzero(
            away <= (np.minimum(found.distance[rest], away[:, 0] + reach) + reach)[:, None]
        )
        triangle = candidates[row, column]
        place = rest[row]
        barycentric = _on_triangles(points[place], corners[triangle])
        nearest = np.einsum("nc,nci->ni", barycentric, corners[triangle])
        gaps = np.linalg.norm(points[place] - nearest, axis=1)
        best = np.full(len(rest), np.inf)
        np.minimum.at(best, row, gaps)
        wins = np.flatnonzero((gaps == best[row]) & (gaps < found.distance[place]))
        found.face[place[wins]] = names[triangle[wins]]
        found.weights[place[wins]] = barycentric[wins]
        found.distance[place[wins]] = gaps[wins]
        if tried == len(centres):
            return
        rest = rest[away[:, -1] <= found.distance[rest] + reach]
        tried = min(4 * tried, len(centres))


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
