"""Coarse mesh with a prescribed local edge length: dual of a centroidal geodesic Voronoi diagram.

After S. Valette and J.-M. Chassery, "Approximated centroidal Voronoi diagrams for uniform polygonal mesh
coarsening" (2004): vertices of a fine mesh are clustered, and each of its triangles whose corners lie in
three clusters gives a triangle of the coarse one. Clusters grow along the surface, so the two sheets of
the lips or lids never merge, however close they are.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra

from ....bench.contracts import FloatArray, IntArray
from ..geometry import mesh_edges


def vertex_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(V,) a third of the area of the triangles around each vertex, square metres."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.bincount(faces.ravel(), np.repeat(area, 3), len(vertices)).astype(float)


def surface_graph(vertices: FloatArray, faces: IntArray, size: FloatArray, *, diagonals: bool) -> csr_matrix:
    """Edges of the mesh, and the short diagonals across them if asked, weighted by length over wanted length.

    Diagonals make distances more even in all directions, but let one cluster leap over another.
    """
    edges = mesh_edges(faces)
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    key = np.sort(edges, axis=1)
    order = np.lexsort(key.T)
    same = (key[order][1:] == key[order][:-1]).all(1)
    diagonal = np.column_stack([opposite[order][1:][same], opposite[order][:-1][same]])
    pairs = np.concatenate([key, diagonal]) if diagonals else key
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    weight = 2 * np.maximum(length, 1e-9) / (size[pairs[:, 0]] + size[pairs[:, 1]])
    return coo_matrix((weight, (pairs[:, 0], pairs[:, 1])), (len(vertices),) * 2).tocsr()


def initial_seeds(vertices: FloatArray, density: FloatArray, count: int) -> IntArray:
    """About ``count`` vertices spread by ``density`` along a Morton curve, hence evenly in space."""
    cells = ((vertices - vertices.min(0)) / 2e-3).astype(np.uint64)
    code = np.zeros(len(vertices), np.uint64)
    for bit in range(9):
        for axis in range(3):
            part = (cells[:, axis] >> np.uint64(bit)) & np.uint64(1)
            code |= part << np.uint64(3 * bit + axis)
    order = np.argsort(code, kind="stable")
    share = np.cumsum(density[order])
    return order[np.unique(np.searchsorted(share, (np.arange(count) + 0.5) * share[-1] / count))]


def coarsen(
    vertices: FloatArray,
    faces: IntArray,
    size: FloatArray,
    *,
    fixed: IntArray,
    border: IntArray,
    iterations: int = 40,
) -> tuple[FloatArray, IntArray]:
    """Coarse mesh of a fine one.

    Parameters
    ----------
    vertices, faces : the fine mesh, manifold, with at least about three edges to a wanted edge.
    size : (V,) wanted edge length, metres.
    fixed : fine vertices that become coarse vertices as they are.
    border : (V,) bit set of the border lines each fine vertex lies on (0 inside). A coarse vertex whose
        cluster touches border lines stays on them, so borders keep their shape.
    iterations : Lloyd steps.

    Returns
    -------
    (V', 3) vertices, of which the first ``len(fixed)`` are the fixed ones, and (F', 3) triangles.
    """
    density = vertex_areas(vertices, faces) / size**2
    even = surface_graph(vertices, faces, size, diagonals=True)
    connected = surface_graph(vertices, faces, size, diagonals=False)
    count = int(density.sum() / 0.866)
    free = np.setdiff1d(initial_seeds(vertices, density, count), fixed)
    seeds = np.concatenate([fixed, free])
    label = np.zeros(len(vertices), int)
    for step in range(iterations):
        last = step == iterations - 1
        _, _, source = dijkstra(
            connected if last else even,
            directed=False,
            indices=seeds,
            min_only=True,
            return_predecessors=True,
        )
        rank = np.full(len(vertices), -1)
        rank[seeds] = np.arange(len(seeds))
        label = rank[source]
        if last:
            break
        seeds = _centers(vertices, label, density, seeds, len(fixed), border)
    corners = label[faces]
    distinct = (
        (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 0] != corners[:, 2])
    )
    triangles = corners[distinct]
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    return vertices[seeds], triangles[np.sort(first)]


def _centers(
    vertices: FloatArray, label: IntArray, density: FloatArray, seeds: IntArray, locked: int, border: IntArray
) -> IntArray:
    """Each cluster's vertex nearest its centroid; among those on the most border lines it touches."""
    total = np.bincount(label, density, len(seeds))
    centroid = (
        np.stack([np.bincount(label, density * vertices[:, k], len(seeds)) for k in range(3)], 1)
        / np.maximum(total, 1e-30)[:, None]
    )
    distance = np.linalg.norm(vertices - centroid[label], axis=1)
    lines = np.array([int(b).bit_count() for b in range(int(border.max()) + 1)])[border]
    order = np.lexsort((distance, -lines, label))
    first = np.searchsorted(label[order], np.arange(len(seeds)))
    moved = order[first]
    moved[:locked] = seeds[:locked]
    return moved
