"""Ribbons for hair, brows and lashes: grown along a field, then turned into triangles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray, IntArray

Field = Callable[[FloatArray, float], FloatArray]
"""Growth direction (n, 3) at points (n, 3), for a share in [0, 1] of the strand's length."""


@dataclass(frozen=True, eq=False)
class Strands:
    """Ribbons at rest. ``root`` (n,) numbers the strand of each vertex."""

    vertices: FloatArray
    faces: IntArray
    albedo: FloatArray
    strand: IntArray

    def joined(self, other: Strands) -> Strands:
        """Both, the strands of ``other`` numbered after these."""
        return Strands(
            np.concatenate([self.vertices, other.vertices]),
            np.concatenate([self.faces, other.faces + len(self.vertices)]),
            np.concatenate([self.albedo, other.albedo]),
            np.concatenate([self.strand, other.strand + 1 + self.strand.max(initial=-1)]),
        )


def grow(
    roots: FloatArray,
    lengths: FloatArray,
    field: Field,
    keep_out: Callable[[FloatArray, float], FloatArray],
    segments: int,
) -> FloatArray:
    """Polylines (n, segments + 1, 3) from ``roots`` along ``field``, each of its own length.

    ``keep_out(points, share)`` moves points that sank into the head back out of it.
    """
    path = [roots]
    step = (lengths / segments)[:, None]
    for index in range(segments):
        share = (index + 1) / segments
        direction = field(path[-1], share)
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
        path.append(keep_out(path[-1] + step * direction, share))
    return np.stack(path, axis=1)


def ribbons(
    paths: FloatArray, outward: FloatArray, width: FloatArray, color: FloatArray, tip_shade: float
) -> Strands:
    """Flat tapered ribbons around paths (n, k, 3).

    Parameters
    ----------
    outward : (n, k, 3) or (n, 1, 3) direction that a ribbon's flat side faces.
    width : (n,) at the root; a quarter of it at the tip.
    color : (n, 3) linear reflectance of each strand.
    tip_shade : factor on the colour at the tip (above 1 for sun-bleached tips).
    """
    count, points = paths.shape[:2]
    along = np.gradient(paths, axis=1)
    across = np.cross(along, np.broadcast_to(outward, paths.shape))
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    taper = np.interp(np.linspace(0.0, 1.0, points), [0.0, 0.6, 1.0], [1.0, 0.85, 0.25])
    half = 0.5 * width[:, None, None] * taper[None, :, None] * across
    vertices = np.stack([paths - half, paths + half], axis=2)  # (n, k, 2, 3)
    index = np.arange(count * points * 2).reshape(count, points, 2)
    a, b, c, d = (index[:, :-1, 0], index[:, :-1, 1], index[:, 1:, 0], index[:, 1:, 1])
    faces = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    shade = np.linspace(1.0, tip_shade, points)[None, :, None, None] * np.ones((1, 1, 2, 1))
    albedo = np.clip(color[:, None, None, :] * shade, 0.003, 0.9)
    strand = np.repeat(np.arange(count), points * 2)
    return Strands(vertices.reshape(-1, 3), faces, albedo.reshape(-1, 3), strand)
