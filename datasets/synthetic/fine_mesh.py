"""The skin of a subject at the size of its details: the tracked mesh with its long edges split."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray, IntArray
from ..head.geometry import unique_pairs, vertex_normals

_ROUNDS = 4  # of splitting long edges
ROUNDING = 0.6  # share of the full projection; Boubekeur and Alexa use 3/4


@dataclass(frozen=True, eq=False)
class FineMesh:
    """Points bound to the triangles of a tracked mesh."""

    faces: IntArray
    """(F', 3) triangles over the fine points."""
    parents: IntArray
    """(N, 3) vertex indices into the tracked mesh."""
    weights: FloatArray
    """(N, 3) barycentric weights, rows sum to 1."""
    parent_faces: IntArray
    """(N,) tracked triangle a point lies on (one of them for points on an edge)."""
    coarse_faces: IntArray
    """(F, 3) the tracked triangles that were refined."""

    def interpolate(self, values: FloatArray) -> FloatArray:
        """Values at the tracked vertices, (V, ...) -> at the fine points, (N, ...)."""
        return np.einsum("nk,nk...->n...", self.weights, values[self.parents])

    def positions(self, vertices: FloatArray) -> FloatArray:
        """(N, 3) fine points over tracked ``vertices`` (V, 3), rounded by Phong tessellation."""
        normals = vertex_normals(vertices, self.coarse_faces)
        corner, normal = vertices[self.parents], normals[self.parents]
        flat = np.einsum("nk,nki->ni", self.weights, corner)
        depth = np.einsum("nki,nki->nk", corner - flat[:, None], normal)
        return flat + ROUNDING * np.einsum("nk,nk,nki->ni", self.weights, depth, normal)

    def frames(self, vertices: FloatArray, points: IntArray) -> FloatArray:
        """Orthonormal frames (n, 3, 3), columns (edge, across, normal), of the triangles under ``points``."""
        corner = vertices[self.coarse_faces[self.parent_faces[points]]]
        edge = corner[:, 1] - corner[:, 0]
        normal = np.cross(edge, corner[:, 2] - corner[:, 0])
        edge = edge / np.maximum(np.linalg.norm(edge, axis=-1, keepdims=True), 1e-20)
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-20)
        return np.stack([edge, np.cross(normal, edge), normal], axis=-1)


def refine(vertices: FloatArray, faces: IntArray, target: FloatArray) -> FineMesh:
    """Split the edges longer than wanted, conformingly, at most `_ROUNDS` times.

    ``vertices``: (V, 3) tracked mesh at rest, metres. ``faces``: (F, 3) triangles to refine; unused vertices are left out.
    ``target``: (V,) longest edge wanted around each vertex, metres.
    """
    used, local = np.unique(faces, return_inverse=True)
    triangles: IntArray = local.reshape(faces.shape).astype(np.int64)
    owner: IntArray = np.arange(len(faces))
    # Barycentric coordinates are with respect to the three corners of ``owner``; a point on an edge may be
    # written by either neighbour, so points carry global parents and weights.
    parents = np.repeat(used[:, None], 3, axis=1)
    weights = np.zeros((len(used), 3))
    weights[:, 0] = 1.0
    point_face = np.zeros(len(used), np.int64)
    point_face[triangles] = owner[:, None]
    position, wanted = vertices[used], target[used]
    for _ in range(_ROUNDS):
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, inverse, _ = unique_pairs(edges)
        length = np.linalg.norm(position[unique[:, 0]] - position[unique[:, 1]], axis=1)
        split = length > 0.5 * (wanted[unique[:, 0]] + wanted[unique[:, 1]])
        if not split.any():
            break
        new_id = np.full(len(unique), -1)
        new_id[split] = len(position) + np.arange(split.sum())
        edge_owner = np.zeros(len(unique), np.int64)
        edge_owner[inverse] = np.repeat(owner, 3)
        ends, above = unique[split], edge_owner[split]
        new_parents = faces[above]
        new_weights = 0.5 * (
            _weights_on(new_parents, parents[ends[:, 0]], weights[ends[:, 0]])
            + _weights_on(new_parents, parents[ends[:, 1]], weights[ends[:, 1]])
        )
        parents, weights = np.concatenate([parents, new_parents]), np.concatenate([weights, new_weights])
        point_face = np.concatenate([point_face, above])
        position = np.concatenate([position, position[ends].mean(axis=1)])
        wanted = np.concatenate([wanted, wanted[ends].mean(axis=1)])
        triangles, owner = _split(triangles, owner, new_id[inverse.reshape(-1, 3)], position)
    return FineMesh(triangles, parents, weights, point_face, np.asarray(faces))


def _weights_on(corners: IntArray, parents: IntArray, weights: FloatArray) -> FloatArray:
    """Rewrite points given over ``parents`` as weights over ``corners`` of a triangle that contains them."""
    return np.einsum("nj,nij->ni", weights, corners[:, :, None] == parents[:, None, :])


def _split(
    triangles: IntArray, owner: IntArray, middle: IntArray, position: FloatArray
) -> tuple[IntArray, IntArray]:
    """Replace each triangle by 1 to 4, depending on which of its edges (01, 12, 20) have a midpoint (>= 0)."""
    count = (middle >= 0).sum(axis=1)
    done, whose = [triangles[count == 0]], [owner[count == 0]]

    def rotated(rows: IntArray, start: IntArray) -> tuple[IntArray, IntArray]:
        turn = (start[:, None] + np.arange(3)) % 3
        return np.take_along_axis(triangles[rows], turn, 1), np.take_along_axis(middle[rows], turn, 1)

    def put(rows: IntArray, *corners: tuple[IntArray, IntArray, IntArray]) -> None:
        for corner in corners:
            done.append(np.stack(corner, axis=1))
            whose.append(owner[rows])

    rows = np.flatnonzero(count == 1)
    (a, b, c), (m, _, _) = (x.T for x in rotated(rows, (middle[rows] >= 0).argmax(axis=1)))
    put(rows, (a, m, c), (m, b, c))

    rows = np.flatnonzero(count == 2)  # turned so that the whole edge is the last one, c-a
    (a, b, c), (m, n, _) = (x.T for x in rotated(rows, ((middle[rows] < 0).argmax(axis=1) + 1) % 3))
    put(rows, (m, b, n))
    short = np.linalg.norm(position[a] - position[n], axis=1) < np.linalg.norm(
        position[m] - position[c], axis=1
    )
    put(rows[short], (a[short], m[short], n[short]), (a[short], n[short], c[short]))
    put(rows[~short], (a[~short], m[~short], c[~short]), (m[~short], n[~short], c[~short]))

    rows = np.flatnonzero(count == 3)
    (a, b, c), (m, n, o) = triangles[rows].T, middle[rows].T
    put(rows, (a, m, o), (m, b, n), (o, n, c), (m, n, o))
    return np.concatenate(done), np.concatenate(whose)
