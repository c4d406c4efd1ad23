"""Points spread evenly over a triangle mesh, given by triangle and barycentric coordinates."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ...bench.contracts import FloatArray, HeadAsset, IntArray
from ...datasets.head.arrays import HeadArrays, faces_in_region
from ...datasets.head.geometry import triangle_areas
from ...datasets.head.teeth import with_teeth_where_possible
from ..shared.avatar_files import head_arrays
from ..shared.schedule import numpy_generator
from .config import GBSConfig

CANDIDATES = 20
"""Number of random candidates per accepted point."""
RADIUS = 0.77
"""Distance between Poisson-disk samples that fill a surface, relative to the square root of the area per sample;
measured between 1,000 and 50,000 samples of a head."""
NEIGHBOURS = 3
SMALLEST_SQUARE = 1e-7
"""Square metres; the minimum mean squared distance to neighbours, as published."""


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

    Dart throwing over random candidates: a candidate is rejected if an accepted one is nearer than the radius (Cook,
    "Stochastic Sampling in Computer Graphics", TOG 1986, section 4). The number found is within a few per cent of
    ``count``. Equal arguments give equal points, unlike MeshLab's sampling, which uses a generator shared by the
    process.

    Parameters
    ----------
    vertices, faces : FloatArray, IntArray
        (V, 3) metres, (F, 3).
    triangles : IntArray
        Indices of the faces to sample.
    """
    corners = np.asarray(vertices, np.float64)[faces[triangles]]
    areas = triangle_areas(vertices, faces[triangles])
    random = numpy_generator(seed, "surface", count)
    chosen = random.choice(len(areas), size=CANDIDATES * count, p=areas / areas.sum())
    root, along = np.sqrt(random.random(len(chosen))), random.random(len(chosen))
    barycentric = full_barycentric(np.column_stack([root * (1 - along), root * along]).astype(np.float32))
    points = (barycentric[:, :, None] * corners[chosen]).sum(1)

    radius, tree = RADIUS * float(np.sqrt(areas.sum() / count)), cKDTree(points)
    left, rows = np.ones(len(points), bool), []
    for row in range(len(points)):
        if left[row]:
            rows.append(row)
            left[tree.query_ball_point(points[row], radius)] = False
    return SurfacePoints(np.asarray(triangles, np.int64)[chosen[rows]], barycentric[rows])


def full_barycentric(last_two: FloatArray) -> FloatArray:
    """(P, 3) float64 barycentric coordinates from the last two of them."""
    last_two = last_two.astype(np.float64)
    return np.column_stack([1 - last_two.sum(1), last_two])


def spacing(points: FloatArray) -> FloatArray:
    """(P,) root mean squared distance of (P, 3) points to their three nearest neighbours, metres."""
    distances = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, len(points)))[0].reshape(len(points), -1)
    squares = (distances[:, 1:] ** 2).mean(1) if distances.shape[1] > 1 else np.zeros(len(points))
    return np.sqrt(np.maximum(squares, SMALLEST_SQUARE))


ROWS = ("teeth_upper", "teeth_lower")
LOWER_TEETH_WEIGHTS = (0.0131, 0.0426, 0.9443)
"""Root, neck and jaw, in the published code."""
MARGIN = 1.1
"""Size of the mouth cylinder relative to the extent of the teeth at rest."""


class MouthCylinder(NamedTuple):
    """An upright cylinder: (3,) centre, radius and half height, metres."""

    center: Tensor
    radius: float
    half_height: float

    def violation(self, points: Tensor) -> Tensor:
        """Mean over (N, 3) points of the squared distances outside the cylinder, horizontally and vertically."""
        x, y, z = (points - self.center).unbind(1)
        # The floor keeps the gradient of the square root finite on the axis, where the penalty is zero.
        outward = (x * x + z * z).clamp_min(1e-12).sqrt() - self.radius
        upward = y.abs() - self.half_height
        return (torch.relu(outward).square() + torch.relu(upward).square()).mean()


def with_mouth(head: HeadAsset, config: GBSConfig) -> HeadArrays:
    """The head with teeth (regions `ROWS`), and with the configured deviations of the published code from the paper.

    Clips have the same teeth for all methods; a head without teeth gets them here. The paper's teeth are two
    billboards of fixed size in FLAME's mouth; these plates follow the lips of any head.
    """
    arrays = with_teeth_where_possible(head_arrays(head))
    if config.lower_teeth_variant == "official" and "teeth_lower" in arrays.regions:
        weights = arrays.skinning_weights.copy()
        weights[arrays.regions["teeth_lower"]] = (*LOWER_TEETH_WEIGHTS, 0, 0)
        arrays = replace(arrays, skinning_weights=weights)
    if config.correctives_variant == "official":
        arrays = replace(arrays, pose_basis=3 * arrays.pose_basis)
    return arrays


def padded_offset(offset: FloatArray, vertices: int) -> FloatArray:
    """(V, 3) static offset of a head, with zeros for the vertices of teeth that were added."""
    return np.concatenate([offset, np.zeros((vertices - len(offset), 3), offset.dtype)])


def rows_of_teeth(head: HeadArrays) -> list[IntArray]:
    """Triangles of the upper and the lower teeth, if there are teeth."""
    return [faces_in_region(head, name) for name in ROWS if name in head.regions]


def mouth_cylinder(vertices: FloatArray) -> MouthCylinder:
    """The cylinder around the teeth at rest, given their (n, 3) vertices.

    The upright cylinder about the middle of the teeth that contains them all, with `MARGIN`. The published one, of
    radius 27.3 mm and half height 21.6 mm, is made for FLAME's mouth.
    """
    low, high = vertices.min(0), vertices.max(0)
    center = 0.5 * (low + high)
    radius = MARGIN * float(np.linalg.norm((vertices - center)[:, [0, 2]], axis=1).max())
    half_height = 0.5 * MARGIN * float(high[1] - low[1])
    return MouthCylinder(torch.as_tensor(center, dtype=torch.float32), radius, half_height)
