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
    paths: FloatArray,
    outward: FloatArray,
    width: FloatArray,
    color: FloatArray,
    *,
    tip_shade: float = 1.0,
    tip_width: float = 0.25,
    arch: float = 0.0,
) -> Strands:
    """Tapered ribbons around paths (n, k, 3).

    Parameters
    ----------
    outward : (n, k, 3) or (n, 1, 3) direction that a ribbon's flat side faces.
    width : (n,) metres, at the root.
    color : (n, c, 3) linear reflectance across each ribbon, c >= 2 columns.
    tip_shade : factor on the colour at the tip (above 1 for sun-bleached tips).
    tip_width : width at the tip as a share of the width at the root.
    arch : how far the middle stands out from the edges, as a share of the width.
    """
    count, points = paths.shape[:2]
    columns = color.shape[1]
    outward = np.broadcast_to(outward, paths.shape)
    across = np.cross(np.gradient(paths, axis=1), outward)
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    taper = np.interp(np.linspace(0.0, 1.0, points), [0.0, 0.6, 1.0], [1.0, 0.9, tip_width])
    wide = (width[:, None] * taper)[:, :, None, None]
    u = np.linspace(-1.0, 1.0, columns)[None, None, :, None]
    vertices = paths[:, :, None] + wide * (
        0.5 * u * across[:, :, None] + arch * (1.0 - u * u) * outward[:, :, None]
    )
    index = np.arange(count * points * columns).reshape(count, points, columns)
    a, b, c, d = (index[:, :-1, :-1], index[:, :-1, 1:], index[:, 1:, :-1], index[:, 1:, 1:])
    faces = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    shade = np.linspace(1.0, tip_shade, points)[None, :, None, None]
    albedo = np.clip(color[:, None] * shade, 0.003, 0.9)
    strand = np.repeat(np.arange(count), points * columns)
    return Strands(vertices.reshape(-1, 3), faces, albedo.reshape(-1, 3), strand)
