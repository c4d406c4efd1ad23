"""Vertices of a fit, their targets on the source's surface, and the resulting identity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, eye_array
from scipy.spatial import cKDTree

from ....bench.contracts import FloatArray, HeadAsset, IntArray
from ....bench.errors import InputError
from ..arrays import faces_in_region, region
from ..geometry import rigid_alignment, vertex_normals
from .problem import solve_bounded
from .settings import RefitSettings

FACE = "face"
EYEBALLS = ("left_eyeball", "right_eyeball")
_LANDMARK_REGIONS = (*EYEBALLS, "lips", "nose")

_ROUNDS = 25
"""Maximum alternations of closest points and identity, for models of different topology."""

_SETTLED = 1e-5
"""Metres; iterations end when the fitted face moves less than this on average."""

FARTHEST = 0.010
"""Metres; a vertex has no counterpart if its closest point is farther."""

_FACING = 0.5
"""Minimum cosine between the normals of counterparts."""

_MILLIMETRES = 1e3


@dataclass(frozen=True, eq=False)
class Matching:
    """Vertices of the target with their counterparts on the source."""

    vertices: IntArray
    """(n,) vertices of the target, ascending."""
    weights: FloatArray
    """(n,) weights of their squared distances."""
    counterparts: csr_array
    """(n, V source) sparse; maps the source's vertices to points on its surface."""
    alignment: FloatArray
    """(4, 4) rigid motion from the source's model space to the target's."""
    shape: FloatArray
    """(S,) identity of the target."""


def fitted_vertices(head: HeadAsset, settings: RefitSettings) -> tuple[IntArray, FloatArray]:
    """Vertices of the face and the eyeballs, (n,) ascending, and their weights (n,)."""
    weights = np.zeros(len(head.template))
    weights[region(head, FACE)] = 1.0
    for name, factor in (("lips", settings.lips), ("eye_region", settings.eye_region)):
        weights[head.regions.get(name, np.zeros(0, dtype=np.int64))] *= factor
    for name in EYEBALLS:
        weights[head.regions.get(name, np.zeros(0, dtype=np.int64))] = settings.eyeballs
    vertices = np.flatnonzero(weights)
    if not len(vertices):
        raise InputError("refit settings", "lips", "a weight above 0 for some vertex", "0 for all")
    return vertices, weights[vertices]


def same_topology(one: HeadAsset, other: HeadAsset) -> bool:
    """Whether vertices of the same index are the same point."""
    return one.template.shape == other.template.shape and np.array_equal(one.faces, other.faces)


def match(source: HeadAsset, neutral: FloatArray, target: HeadAsset, settings: RefitSettings) -> Matching:
    """Find counterparts and identity of the target for a subject's neutral head in the source's model.

    For equal topologies counterparts have equal indices. Otherwise they are closest points on the source's surface,
    region by region, alternated with a rigid alignment and the identity, and initialised by aligning the centres of
    common regions.

    ``neutral``: (V source, 3) metres.
    """
    vertices, weights = fitted_vertices(target, settings)
    if same_topology(source, target):
        counterparts = csr_array(eye_array(len(source.template), format="csr")[vertices])
        shape = fit_shape(target, vertices, weights, neutral[vertices], settings)
        return Matching(vertices, weights, counterparts, np.eye(4), shape)
    alignment = _first_alignment(source, neutral, target)
    shape = np.zeros(target.shape_basis.shape[2])
    kept = np.ones(len(vertices), dtype=bool)
    for _ in range(_ROUNDS):
        aligned = neutral @ alignment[:3, :3].T + alignment[:3, 3]
        fitted = np.asarray(target.template + target.shape_basis @ shape, dtype=np.float64)
        matrix, kept = _counterparts(source, aligned, target, fitted, vertices)
        if kept.sum() < max(100, 0.2 * len(vertices)):
            found = f"{int(kept.sum())} of {len(vertices)} vertices with a counterpart"
            raise InputError(f"head model {source.version!r}", FACE, "a face near the target's", found)
        chosen, rows = vertices[kept], matrix[np.flatnonzero(kept)]
        alignment = rigid_alignment(rows @ neutral, fitted[chosen], weights[kept])
        wanted = (rows @ neutral) @ alignment[:3, :3].T + alignment[:3, 3]
        shape = fit_shape(target, chosen, weights[kept], wanted, settings)
        moved = np.asarray(target.shape_basis[chosen] @ shape + target.template[chosen]) - fitted[chosen]
        if np.linalg.norm(moved, axis=1).mean() < _SETTLED:
            break
    return Matching(chosen, weights[kept], csr_array(rows), alignment, shape)


def fit_shape(
    target: HeadAsset, vertices: IntArray, weights: FloatArray, wanted: FloatArray, settings: RefitSettings
) -> FloatArray:
    """(S,) identity whose neutral head is nearest to points ``wanted`` (n, 3) at ``vertices``, in its bounds."""
    basis = _MILLIMETRES * np.asarray(target.shape_basis[vertices], dtype=np.float64)
    basis = basis.reshape(3 * len(vertices), -1)
    missing = _MILLIMETRES * (wanted - target.template[vertices]).reshape(-1)
    weighted = basis * np.repeat(weights / weights.sum(), 3)[:, None]
    normal = weighted.T @ basis
    normal[np.diag_indices(len(normal))] += settings.prior_mm**2
    return solve_bounded(normal, weighted.T @ missing, np.full(len(normal), settings.coefficient_bound))


def _first_alignment(source: HeadAsset, neutral: FloatArray, target: HeadAsset) -> FloatArray:
    regions = source.regions, target.regions
    names = [name for name in _LANDMARK_REGIONS if all(len(known.get(name, ())) for known in regions)]
    if len(names) < 3:
        expected = f"at least three of the regions {', '.join(_LANDMARK_REGIONS)} in both models"
        raise InputError(f"head model {source.version!r}", "regions", expected, ", ".join(names) or "none")
    here = np.array([neutral[source.regions[name]].mean(axis=0) for name in names])
    centres = np.array([target.template[target.regions[name]].mean(axis=0) for name in names])
    return rigid_alignment(here, centres)


def _counterparts(
    source: HeadAsset, aligned: FloatArray, target: HeadAsset, fitted: FloatArray, vertices: IntArray
) -> tuple[csr_array, np.ndarray]:
    """(n, V source) closest points of the fitted target's vertices, and (n,) which of them count."""
    normals = vertex_normals(fitted, target.faces)
    source_normals = vertex_normals(aligned, source.faces)
    kept = np.zeros(len(vertices), dtype=bool)
    whole = csr_array((len(vertices), len(aligned)))
    eyeballs = {name: np.isin(vertices, target.regions.get(name, ())) for name in EYEBALLS}
    parts = {FACE: ~np.any([*eyeballs.values()], axis=0), **eyeballs}
    for name, part in parts.items():
        rows = np.flatnonzero(part)
        if not len(rows) or name not in source.regions:
            continue
        faces = source.faces[faces_in_region(source, name)]
        closest = closest_points(fitted[vertices[rows]], aligned, faces)
        whole = whole + closest.matrix(faces, len(aligned), rows, len(vertices))
        facing = np.einsum("ni,ni->n", normals[vertices[rows]], (whole @ source_normals)[rows])
        kept[rows] = (closest.distance < FARTHEST) & (facing > _FACING)
    return csr_array(whole), kept


_FIRST_CANDIDATES = 12


class ClosestPoints(NamedTuple):
    """Closest points of n points on a surface."""

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

    Triangles of similar size are searched together, the smallest last, in the order of the distance of their centres,
    until the next centre is farther than the best distance plus the largest distance from a centre to a corner in the
    group.
    """
    corners = vertices[faces]
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    size = np.floor(np.log2(np.maximum(radii, 1e-3 * radii.max() + np.finfo(float).tiny))).astype(np.int64)
    closest = ClosestPoints(
        np.zeros(len(points), dtype=np.int64), np.zeros((len(points), 3)), np.full(len(points), np.inf)
    )
    for alike in np.unique(size)[::-1]:
        members = np.flatnonzero(size == alike)
        _search(points, corners[members], centres[members], float(radii[members].max()), members, closest)
    return closest


def _search(
    points: FloatArray,
    corners: FloatArray,
    centres: FloatArray,
    reach: float,
    names: IntArray,
    found: ClosestPoints,
) -> None:
    """Update ``found`` with nearer points."""
    tree = cKDTree(centres)
    rest, tried = np.arange(len(points)), min(_FIRST_CANDIDATES, len(centres))
    while len(rest):
        away, candidates = tree.query(points[rest], k=tried)
        away, candidates = away.reshape(-1, tried), candidates.reshape(-1, tried)
        # Only candidates that may be nearest are measured, since most are too far.
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
    """(..., 3) barycentric weights of the points of triangles (..., 3, 3) closest to points (..., 3). This is the foot
    in the plane if it is inside, else the nearest of the closest points on the three edges."""
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
