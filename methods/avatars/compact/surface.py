"""Surface points of splats in coded files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ....bench.contracts import HeadAsset
from ....bench.errors import InputError
from ...shared.surface_points import SurfacePoints, full_barycentric
from .container import Arrays, Content, coded, narrow
from .precision import Precision

BARYCENTRIC_STEP = 1 / 16


def encode_points(
    points: SurfacePoints, precision: Precision, step: float = BARYCENTRIC_STEP
) -> dict[str, np.ndarray]:
    """Arrays of points sorted by triangle. They are rounded, so positions must be stored relative to the decoded points."""
    inside = points.barycentric[:, 1:].T
    return {
        "triangles": narrow(np.diff(points.triangles, prepend=0)),
        "barycentric": coded(inside, step if precision.positions else 0.0),
    }


def decode_points(arrays: Arrays, head: HeadAsset, step: float = BARYCENTRIC_STEP) -> SurfacePoints:
    """Inverse of `encode_points` up to rounding. Raises `InputError` where they do not fit the head."""
    triangles = np.cumsum(arrays.integers("triangles", None).astype(np.int64))
    if not len(triangles) or triangles[-1] >= len(head.faces):
        raise InputError(arrays.path, "triangles", f"triangles 0 to {len(head.faces) - 1}", "none or others")
    inside = arrays.decoded("barycentric", step, 2, len(triangles))
    return SurfacePoints(triangles, full_barycentric(inside.T.astype(np.float32)))


def points_as_read(encoded: dict[str, np.ndarray], head: HeadAsset) -> SurfacePoints:
    """The points as decoded from these arrays."""
    return decode_points(Arrays(Path(), Content(encoded)), head)
