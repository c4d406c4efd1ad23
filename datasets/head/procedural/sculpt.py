"""Sculpt the default head anew: ``python -m headbench.datasets.head.procedural.sculpt --out FILE``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pymeshlab
import tyro
from scipy.spatial import cKDTree

from ....bench.contracts import FloatArray, IntArray
from ....bench.io.files import atomic_path
from ..geometry import border_edges
from .anatomy import (
    CLOSED_LIP_GAP,
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
    slit_height,
)
from .features import EAR_ORIGIN, sculpture
from .polygonise import polygonise
from .remesh import coarsen

SHORTEST_EDGE = 0.00035  # metres; the sheets of lids and lips are sculpted several times further apart
LOW, HIGH = (0.0, FLOOR, -0.13), (0.115, 0.15, 0.11)


@dataclass(frozen=True)
class Settings:
    """How finely to sculpt.

    Attributes
    ----------
    out : npz to write: ``vertices`` (V, 3) float32 metres, ``faces`` (F, 3) int32, ``mirror`` (V,) int32.
    step : voxel of the fine surface, metres.
    detail : factor on the wanted edge lengths; smaller is finer.
    """

    out: Path
    step: float = 0.0007
    detail: float = 1.13


def edge_length(points: FloatArray) -> FloatArray:
    """(N,) wanted length of the edges at each point, metres: fine at features, smoothly coarser away."""
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
    lip = np.linspace(0, LIP_RING_REACH * MOUTH_HALF_WIDTH, 15)  # every other one is of the lips' rings
    height = LIP_RING_HEIGHT + (SCULPTED_LIP_GAP - CLOSED_LIP_GAP) / 2
    for side in (1, -1):
        rims.append(np.column_stack([lip, slit_height(lip) + side * height, lip_arc(lip) + 0.004]))
    return np.concatenate(rims)


def clean(vertices: FloatArray, faces: IntArray, *, merge: float, flip: bool) -> tuple[FloatArray, IntArray]:
    """Largest piece of the mesh; vertices nearer than ``merge`` metres made one, slivers flipped if asked."""
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
    """Whole head from its left half, welded at x = 0, and each vertex's mirror image."""
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
    """Those of the candidates, taken in order, that keep their ``spacing`` (V,) from all taken before."""
    taken: list[int] = []
    for vertex in candidates:
        if not taken or np.linalg.norm(vertices[taken] - vertices[vertex], axis=1).min() > spacing[vertex]:
            taken.append(int(vertex))
    return np.array(taken)


def main(settings: Settings) -> None:
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
    main(tyro.cli(Settings))
