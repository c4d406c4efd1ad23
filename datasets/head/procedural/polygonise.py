"""From the implicit head to a fine triangle mesh of its left half: narrow-band marching cubes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from skimage.measure import marching_cubes

from ....bench.contracts import FloatArray, IntArray

BLOCK = 8  # voxels along the side of a block of the narrow band


def polygonise(
    field: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray, step: float
) -> tuple[FloatArray, IntArray]:
    """Zero set of ``field`` in the box, as vertices (V, 3) and outward triangles (F, 3).

    The field is sampled at ``step`` only in blocks that its value at their centres says the surface may meet;
    it must not grow faster than about 1.5 metres a metre.
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
