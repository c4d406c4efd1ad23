"""The head of GaussianBlendshapes: rows of teeth, and the cylinder of the mouth that contains them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import FloatArray, HeadAsset, IntArray
from ...datasets.head.arrays import HeadArrays, faces_in_region
from ...datasets.head.teeth import with_teeth_where_possible
from ..shared.avatar_files import head_arrays
from .config import GBSConfig

ROWS = ("teeth_upper", "teeth_lower")
LOWER_TEETH_WEIGHTS = (0.0131, 0.0426, 0.9443)
"""Root, neck and jaw, in the published code."""
MARGIN = 1.1
"""Size of the mouth cylinder relative to the extent of the teeth at rest."""


class MouthCylinder(NamedTuple):
    """Upright cylinder: (3,) centre, radius and half height, metres."""

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
