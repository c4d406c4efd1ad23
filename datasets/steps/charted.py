"""A chart for head models without texture coordinates, for methods that place splats on a chart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...bench.contracts import Clip, FloatArray, IntArray
from ...bench.engine.config import RunConfig
from ..clip import CaptureClip, as_capture

SHEAR = np.tan(np.radians(18))
"""Shear of the triangles, so that the directions along the two coordinates are 18 degrees from orthogonal, the median in FLAME's
chart."""
MARGIN = 0.05
"""Fraction of a cell left free around the largest triangle."""


def with_packed_chart(clip: Clip, config: RunConfig) -> CaptureClip:
    """A clip whose head model has texture coordinates: its own, or those of `packed_chart`."""
    source = as_capture(clip)
    if source.head.uv is not None:
        return source
    uv = packed_chart(np.asarray(source.head.template), np.asarray(source.head.faces))
    return source.derive("with_packed_chart", {}, head=replace(source.head, uv=uv))


def packed_chart(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(F, 3, 2) texture coordinates in [0, 1], in which every triangle has a cell of a square grid.

    Triangles have the same scale and are sheared by `SHEAR`, so that areas in the chart are proportional to those on the mesh.

    Parameters
    ----------
    vertices, faces : FloatArray, IntArray
        (V, 3) metres, (F, 3).
    """
    v0, v1, v2 = np.moveaxis(np.asarray(vertices, np.float64)[faces], 1, 0)
    # A triangle without area stays one: no division by 0.
    base = np.maximum(np.linalg.norm(v1 - v0, axis=1), np.finfo(np.float64).tiny)
    along = ((v2 - v0) * (v1 - v0)).sum(1) / base
    height = np.linalg.norm(np.cross(v1 - v0, v2 - v0), axis=1) / base
    flat = np.zeros((len(faces), 3, 2))
    flat[:, 1, 0] = base
    flat[:, 2] = np.column_stack([along + SHEAR * height, height])
    flat -= flat.min(1, keepdims=True)
    flat *= (1 - 2 * MARGIN) / flat.max()
    across = int(np.ceil(np.sqrt(len(faces))))
    row, column = np.divmod(np.arange(len(faces)), across)
    return ((flat + MARGIN + np.column_stack([column, row])[:, None]) / across).astype(np.float32)
