"""Points spread evenly over a triangle mesh, each known by its triangle and its place in it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pymeshlab
from scipy.spatial import cKDTree

from ...bench.contracts import FloatArray, IntArray
from ..shared.schedule import numpy_generator

CANDIDATES = 20
"""Random points drawn for each that is kept."""
RADIUS = 0.82
"""Distance between Poisson-disk samples, where as many as asked for fill a surface of that area, over the root of the
area per sample; measured between 1,000 and 50,000 samples of a head."""
NEIGHBOURS = 3
SMALLEST_SQUARE = 1e-7
"""Square metres; the least mean squared distance to neighbours, as published."""


class SurfacePoints(NamedTuple):
    """Points on a mesh: (P,) int64 triangles and (P, 3) barycentric coordinates, which add up to 1.

    The last two coordinates are float32 numbers, which is how they are stored.
    """

    triangles: IntArray
    barycentric: FloatArray

    def positions(self, vertices: FloatArray, faces: IntArray) -> FloatArray:
        """(P, 3) positions on a mesh of (V, 3) vertices."""
        return (self.barycentric[:, :, None] * vertices[faces[self.triangles]]).sum(1)


def poisson_disk(
    vertices: FloatArray, faces: IntArray, triangles: IntArray, count: int, seed: int
) -> SurfacePoints:
    """About ``count`` points on some triangles of a mesh, no two of them close: blue noise.

    Corsini, Cignoni and Scopigno, "Efficient and Flexible Sampling with Blue Noise Properties of Triangular Meshes",
    TVCG 2012, as MeshLab has it, on candidates drawn here, so that each sample's triangle is known. The number found
    is within a few per cent of the one asked for. Equal arguments give equal points.

    Parameters
    ----------
    vertices, faces : (V, 3) metres, (F, 3).
    triangles : which of the faces.
    seed : of the run.
    """
    corners = np.asarray(vertices, np.float64)[faces[triangles]]
    areas = _areas(corners)
    random = numpy_generator(seed, "surface", count)
    chosen = random.choice(len(areas), size=CANDIDATES * count, p=areas / areas.sum())
    root, along = np.sqrt(random.random(len(chosen))), random.random(len(chosen))
    barycentric = full_barycentric(np.column_stack([root * (1 - along), root * along]).astype(np.float32))
    points = (barycentric[:, :, None] * corners[chosen]).sum(1)

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(points))
    radius = pymeshlab.PureValue(RADIUS * float(np.sqrt(areas.sum() / count)))
    meshes.generate_sampling_poisson_disk(radius=radius, subsample=True)
    # The samples are candidates, but MeshLab does not say which.
    rows = np.sort(cKDTree(points).query(meshes.current_mesh().vertex_matrix())[1])
    return SurfacePoints(np.asarray(triangles, np.int64)[chosen[rows]], barycentric[rows])


def full_barycentric(last_two: FloatArray) -> FloatArray:
    """(P, 3) float64 barycentric coordinates from the last two of them."""
    last_two = last_two.astype(np.float64)
    return np.column_stack([1 - last_two.sum(1), last_two])


def surface_area(vertices: FloatArray, faces: IntArray) -> float:
    """Area of a mesh, square metres."""
    return float(_areas(np.asarray(vertices, np.float64)[faces]).sum())


def _areas(corners: FloatArray) -> FloatArray:
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas: FloatArray = 0.5 * np.linalg.norm(np.cross(one, other), axis=1)
    return areas


def spacing(points: FloatArray) -> FloatArray:
    """(P,) root mean squared distance of (P, 3) points to their three nearest neighbours, metres."""
    distances = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, len(points)))[0].reshape(len(points), -1)
    squares = (distances[:, 1:] ** 2).mean(1) if distances.shape[1] > 1 else np.zeros(len(points))
    return np.sqrt(np.maximum(squares, SMALLEST_SQUARE))
