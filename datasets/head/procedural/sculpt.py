"""Sculpt the default head again: ``python -m headbench.datasets.head.procedural.sculpt --out FILE``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from ....bench.contracts import FloatArray, IntArray
from ....bench.io.files import atomic_path
from ..geometry import border_edges, mesh_edges, triangle_areas, unique_pairs
from .sculpture import (
    CLOSED_LIP_GAP,
    EAR_ORIGIN,
    EYE_CENTER,
    FLOOR,
    LATERAL_CANTHUS,
    LIP_RING_HEIGHT,
    LIP_RING_REACH,
    MEDIAL_CANTHUS,
    MOUTH_HALF_WIDTH,
    SCULPTED_LIP_GAP,
    close_mouth,
    eye_front,
    lid_curves,
    lip_arc,
    sculpture,
    slit_height,
)

SHORTEST_EDGE = 0.00035  # metres; lids and lips are sculpted several times further apart
ITERATIONS = 40  # of centring the clusters that become coarse vertices
LOW, HIGH = (0.0, FLOOR, -0.13), (0.115, 0.15, 0.11)


@dataclass(frozen=True)
class SculptSettings:
    """Settings of the sculptor."""

    out: Path
    """Output npz: ``vertices`` (V, 3) float32 metres, ``faces`` (F, 3) int32, ``mirror`` (V,) int32."""
    step: float = 0.0007
    """Voxel size of the fine surface, metres."""
    detail: float = 1.13
    """Factor on the wanted edge lengths; smaller is finer."""


def edge_length(points: FloatArray) -> FloatArray:
    """(N,) target edge length at each point, metres: fine at features, smoothly coarser elsewhere."""
    x, y, z = points.T
    eye = points - EYE_CENTER
    top, bottom = lid_curves(eye[:, 0])
    margin = np.hypot(np.maximum(np.maximum(eye[:, 1] - top, bottom - eye[:, 1]), 0), eye[:, 2] - 0.011)
    lips = np.hypot(np.maximum(np.abs(y - slit_height(x)) - 0.006, 0), np.minimum(z - lip_arc(x) + 0.001, 0))
    lips = np.hypot(lips, np.maximum(x - MOUTH_HALF_WIDTH, 0))
    nose = np.linalg.norm(
        np.maximum(np.abs(points - (0.006, -0.0215, 0.082)) - (0.013, 0.010, 0.012), 0), axis=1
    )
    ear = np.linalg.norm(
        np.maximum(np.abs(points - np.add(EAR_ORIGIN, (0.008, 0.005, -0.010))) - (0.012, 0.030, 0.022), 0),
        axis=1,
    )
    face = np.linalg.norm(np.maximum(np.abs(points - (0, -0.02, 0.07)) - (0.055, 0.075, 0.035), 0), axis=1)
    wanted = np.full(len(points), 0.0115)
    for distance, size, growth in (
        (margin, 0.0010, 0.17),
        (lips, 0.0021, 0.22),
        (nose, 0.0024, 0.22),
        (ear, 0.0028, 0.30),
        (face, 0.0056, 0.11),
    ):
        wanted = np.minimum(wanted, size + growth * np.maximum(distance, 0))
    return wanted


def feature_points() -> FloatArray:
    """(P, 3) points of the left half that become vertices: lid margins and the contour of the lips."""
    x = np.linspace(0.97 * MEDIAL_CANTHUS, 0.97 * LATERAL_CANTHUS, 24)
    upper, lower = lid_curves(x)
    rims = [eye_front(x, y, 0.0010) for y in (upper + 0.0006, lower - 0.0006)]
    lip = np.linspace(0, LIP_RING_REACH * MOUTH_HALF_WIDTH, 15)  # every second one belongs to the lips' rings
    height = LIP_RING_HEIGHT + (SCULPTED_LIP_GAP - CLOSED_LIP_GAP) / 2
    for side in (1, -1):
        rims.append(np.column_stack([lip, slit_height(lip) + side * height, lip_arc(lip) + 0.004]))
    return np.concatenate(rims)


def clean(vertices: FloatArray, faces: IntArray, *, merge: float, flip: bool) -> tuple[FloatArray, IntArray]:
    """Largest piece of the mesh, with vertices nearer than ``merge`` metres merged, and slivers flipped if requested."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    meshes.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(merge))
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_remove_null_faces()
    meshes.meshing_repair_non_manifold_edges()
    meshes.meshing_remove_connected_component_by_face_number(mincomponentsize=len(faces) // 2)
    meshes.meshing_remove_unreferenced_vertices()
    if flip:
        meshes.meshing_edge_flip_by_planar_optimization(pthreshold=25, iterations=0)
    mesh = meshes.current_mesh()
    return mesh.vertex_matrix(), mesh.face_matrix().astype(np.int64)


def mirrored(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray, IntArray]:
    """Full head from its left half, joined at x = 0, and each vertex's mirror image."""
    middle = np.abs(vertices[:, 0]) < 1e-9
    count = len(vertices)
    image = np.arange(count)
    image[~middle] = count + np.arange((~middle).sum())
    whole = np.concatenate([vertices, vertices[~middle] * [-1, 1, 1]])
    mirror = np.empty(len(whole), int)
    mirror[:count], mirror[image] = image, np.arange(count)
    return whole, np.concatenate([faces, image[faces[:, ::-1]]]), mirror


def sculpt(step: float, detail: float) -> tuple[FloatArray, IntArray, IntArray]:
    """Vertices (V, 3), triangles (F, 3) and mirror images (V,) of the skin, metres."""
    vertices, faces = clean(
        *polygonise(sculpture, np.array(LOW), np.array(HIGH), step), merge=1e-6, flip=False
    )
    on_border = np.zeros(len(vertices), int)
    edge_vertices = np.unique(border_edges(faces))
    on_border[edge_vertices] += np.abs(vertices[edge_vertices, 0] - LOW[0]) < step / 10
    on_border[edge_vertices] += 2 * (np.abs(vertices[edge_vertices, 1] - LOW[1]) < step / 10)
    size = detail * edge_length(vertices)
    fixed = _spaced(vertices, cKDTree(vertices).query(feature_points())[1], 0.75 * size)
    corners = np.flatnonzero(on_border == 3)
    coarse, triangles = coarsen(vertices, faces, size, fixed=np.union1d(fixed, corners), border=on_border)
    coarse[np.abs(coarse[:, 0]) < step / 10, 0] = 0
    coarse, triangles = clean(coarse, triangles, merge=SHORTEST_EDGE, flip=True)
    whole, triangles, mirror = mirrored(coarse, triangles)
    return close_mouth(whole), triangles, mirror


def _spaced(vertices: FloatArray, candidates: IntArray, spacing: FloatArray) -> IntArray:
    """Candidates, in order, with a distance of at least ``spacing`` (V,) from all previously selected ones."""
    taken: list[int] = []
    for vertex in candidates:
        if not taken or np.linalg.norm(vertices[taken] - vertices[vertex], axis=1).min() > spacing[vertex]:
            taken.append(int(vertex))
    return np.array(taken)


def main(settings: SculptSettings) -> None:
    """Sculpt and write the head."""
    vertices, faces, mirror = sculpt(settings.step, settings.detail)
    with atomic_path(settings.out) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(
            stream,
            vertices=vertices.astype(np.float32),
            faces=faces.astype(np.int32),
            mirror=mirror.astype(np.int32),
        )
    print(f"{settings.out}: {len(vertices)} vertices, {len(faces)} triangles")


if __name__ == "__main__":
    main(tyro.cli(SculptSettings))


BLOCK = 8  # voxels along the side of a block of the narrow band


def polygonise(
    field: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray, step: float
) -> tuple[FloatArray, IntArray]:
    """Zero set of ``field`` in the box, as vertices (V, 3) and outward triangles (F, 3).

    The field is sampled at ``step`` only in blocks that the surface may cross according to its value at their centres;
    its slope must not exceed about 1.5.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    blocks = np.ceil((high - low) / (step * BLOCK)).astype(int)
    centers = low + (np.stack(np.meshgrid(*map(np.arange, blocks), indexing="ij"), -1) + 0.5) * BLOCK * step
    coarse = field(centers.reshape(-1, 3).astype(np.float32)).reshape(blocks)
    near = np.abs(coarse) < 1.5 * step * BLOCK * np.sqrt(3) / 2
    grid = np.kron(coarse, np.ones((BLOCK,) * 3, np.float32)).astype(np.float32)
    offsets = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), -1)
    corner = np.argwhere(near) * BLOCK
    for chunk in np.array_split(corner, max(1, len(corner) // 1500)):
        index = (chunk[:, None, None, None] + offsets).reshape(-1, 3)
        values = field((low + index * step).astype(np.float32))
        grid[tuple(index.T)] = values
    vertices, faces, _, _ = marching_cubes(grid, 0.0, spacing=(step,) * 3, gradient_direction="descent")
    return vertices.astype(np.float64) + low, faces.astype(np.int64)


def vertex_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(V,) a third of the area of the triangles at each vertex, square metres."""
    share = triangle_areas(vertices, faces) / 3
    return np.bincount(faces.ravel(), np.repeat(share, 3), len(vertices)).astype(float)


def surface_graph(vertices: FloatArray, faces: IntArray, size: FloatArray, *, diagonals: bool) -> csr_matrix:
    """Edges of the mesh, optionally with the short diagonals across them, weighted by length relative to the target
    length. Diagonals make distances more even in all directions, but let one cluster leap over another."""
    edges = mesh_edges(faces)
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    key = np.sort(edges, axis=1)
    order = np.lexsort(key.T)
    same = (key[order][1:] == key[order][:-1]).all(1)
    diagonal = np.column_stack([opposite[order][1:][same], opposite[order][:-1][same]])
    pairs = np.concatenate([key, diagonal]) if diagonals else key
    pairs, _, _ = unique_pairs(np.sort(pairs, axis=1))
    length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    weight = 2 * np.maximum(length, 1e-9) / (size[pairs[:, 0]] + size[pairs[:, 1]])
    return coo_matrix((weight, (pairs[:, 0], pairs[:, 1])), (len(vertices),) * 2).tocsr()


def initial_seeds(vertices: FloatArray, density: FloatArray, count: int) -> IntArray:
    """About ``count`` vertices spread by ``density`` along a Morton curve, hence evenly in space."""
    cells = ((vertices - vertices.min(0)) / 2e-3).astype(np.uint64)
    code = np.zeros(len(vertices), np.uint64)
    for bit in range(9):
        for axis in range(3):
            bits = (cells[:, axis] >> np.uint64(bit)) & np.uint64(1)
            code |= bits << np.uint64(3 * bit + axis)
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
) -> tuple[FloatArray, IntArray]:
    """Coarse mesh of a fine one.

    ``vertices``, ``faces``: The fine mesh, manifold, with at least about three edges per target edge. ``size``: (V,) target
    edge length, metres. ``fixed``: Fine vertices that become coarse vertices unchanged. ``border``: (V,) bit set of the
    border lines through each fine vertex (0 inside). A coarse vertex whose cluster touches border lines stays on them, so
    borders keep their shape.

    Returns
    -------
    tuple[FloatArray, IntArray]
        (V', 3) vertices, of which the first ``len(fixed)`` are the fixed ones, and (F', 3) triangles.
    """
    density = vertex_areas(vertices, faces) / size**2
    even = surface_graph(vertices, faces, size, diagonals=True)
    connected = surface_graph(vertices, faces, size, diagonals=False)
    count = int(density.sum() / 0.866)
    free = np.setdiff1d(initial_seeds(vertices, density, count), fixed)
    seeds = np.concatenate([fixed, free])
    label = np.zeros(len(vertices), int)
    for step in range(ITERATIONS):
        last = step == ITERATIONS - 1
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
    """Each cluster's vertex nearest to its centroid, among those on most of its border lines."""
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
