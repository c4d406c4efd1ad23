"""Which vertices a fit looks at, where their targets lie on the source's surface, and the identity they give."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, eye_array

from ....bench.contracts import FloatArray, HeadAsset, IntArray
from ....bench.errors import InputError
from ..geometry import rigid_alignment, vertex_normals
from ..regions import faces_in_region
from .bounded import solve_bounded
from .correspondence import closest_points
from .settings import RefitSettings

FACE = "face"
EYEBALLS = ("left_eyeball", "right_eyeball")
_LANDMARK_REGIONS = (*EYEBALLS, "lips", "nose")

_ROUNDS = 25
"""At most so many of closest points and identity in turn, for models of different topology."""

_SETTLED = 1e-5
"""Metres; the rounds end when the fitted face moves less than this on average."""

FARTHEST = 0.010
"""Metres; a vertex whose closest point is farther has no counterpart."""

_FACING = 0.5
"""Least cosine between the normals of counterparts."""

_MILLIMETRES = 1e3


@dataclass(frozen=True, eq=False)
class Matching:
    """Vertices of the target with their counterparts on the source.

    Attributes
    ----------
    vertices : (n,) of the target, ascending.
    weights : (n,) of their squared distances.
    counterparts : (n, V source) sparse; takes the source's vertices to points on its surface.
    alignment : (4, 4) rigid motion from the source's model space to the target's.
    shape : (S,) identity of the target.
    """

    vertices: IntArray
    weights: FloatArray
    counterparts: csr_array
    alignment: FloatArray
    shape: FloatArray


def fitted_vertices(head: HeadAsset, settings: RefitSettings) -> tuple[IntArray, FloatArray]:
    """Vertices of the face and the eyeballs, (n,) ascending, and their weights (n,).

    Raises `InputError` where the head has no face region.
    """
    weights = np.zeros(len(head.template))
    if not len(head.regions.get(FACE, ())):
        known = ", ".join(sorted(head.regions)) or "no regions"
        remedy = "For a FLAME pickle, give FLAME_masks.pkl beside it."
        raise InputError(f"head model {head.version!r}", "regions", f"a region {FACE!r}", known, remedy)
    weights[head.regions[FACE]] = 1.0
    for name, factor in (("lips", settings.lips), ("eye_region", settings.eye_region)):
        weights[head.regions.get(name, np.zeros(0, dtype=np.int64))] *= factor
    for name in EYEBALLS:
        weights[head.regions.get(name, np.zeros(0, dtype=np.int64))] = settings.eyeballs
    vertices = np.flatnonzero(weights)
    if not len(vertices):
        raise InputError("refit settings", "lips", "a weight above 0 for some vertex", "0 for all")
    return vertices, weights[vertices]


def same_topology(one: HeadAsset, other: HeadAsset) -> bool:
    """Whether vertices of the same index mean the same point."""
    return one.template.shape == other.template.shape and np.array_equal(one.faces, other.faces)


def match(source: HeadAsset, neutral: FloatArray, target: HeadAsset, settings: RefitSettings) -> Matching:
    """Find counterparts and identity of the target for a subject's neutral head in the source's model.

    Over one topology counterparts are equal indices. Else closest points on the source's surface, region by
    region, found in turn with a rigid alignment and the identity, from an alignment of common regions' centres.

    Parameters
    ----------
    neutral : (V source, 3) metres.

    Raises
    ------
    InputError
        Where a head lacks a face region, or too few counterparts are found.
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
    names = [name for name in _LANDMARK_REGIONS if name in source.regions and name in target.regions]
    if len(names) < 3:
        expected = f"at least three of the regions {', '.join(_LANDMARK_REGIONS)} in both models"
        raise InputError(f"head model {source.version!r}", "regions", expected, ", ".join(names) or "none")
    here = np.array([neutral[source.regions[name]].mean(axis=0) for name in names])
    there = np.array([target.template[target.regions[name]].mean(axis=0) for name in names])
    return rigid_alignment(here, there)


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
        found = closest_points(fitted[vertices[rows]], aligned, faces)
        whole = whole + found.matrix(faces, len(aligned), rows, len(vertices))
        facing = np.einsum("ni,ni->n", normals[vertices[rows]], (whole @ source_normals)[rows])
        kept[rows] = (found.distance < FARTHEST) & (facing > _FACING)
    return csr_array(whole), kept
