"""Cameras as arrays: projection with derivatives, and visibility by a coarse depth buffer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...bench.contracts import BoolArray, Camera, FloatArray, HeadAsset, IntArray
from ..head.geometry import triangle_areas, vertex_normals

CELL = 4
"""Side of a cell of the depth buffer, pixels."""
MARGIN = 0.006
"""A point is hidden if something is nearer by more than this, metres."""
FACING = 0.25
"""Least cosine between the normal of a point and the direction to the camera."""
_SPACING = 0.003  # between the samples of a surface that fill the buffer, metres
_NEAR = 0.05


class Projection(NamedTuple):
    """Points in the images of C cameras."""

    pixels: FloatArray
    """(C, P, 2) in pixels, (0, 0) being the corner of the image."""
    depth: FloatArray
    """(C, P) metres."""
    derivative: FloatArray
    """(C, P, 2, 3) of the pixels by the points in the world."""


class Views:
    """C cameras.

    Parameters
    ----------
    cameras : Sequence[Camera]
        Cameras of any sizes.
    """

    def __init__(self, cameras: Sequence[Camera]):
        self.cameras = [*cameras]
        self.rotations = np.stack([camera.world_to_camera[:3, :3] for camera in cameras]).astype(np.float64)
        self.shifts = np.stack([camera.world_to_camera[:3, 3] for camera in cameras]).astype(np.float64)
        self.intrinsics = np.stack([camera.K for camera in cameras]).astype(np.float64)
        self.centers = np.stack([camera.center for camera in cameras])
        self.sizes = np.array([[camera.width, camera.height] for camera in cameras])

    def project(self, points: FloatArray, which: IntArray | None = None) -> Projection:
        """Project points (P, 3), or with ``which`` (P,) each in the camera of that index, then without the axis C."""
        if which is None:
            turn, shift, K = self.rotations[:, None], self.shifts[:, None], self.intrinsics[:, None]
            seen = np.einsum("cij,pj->cpi", self.rotations, points) + shift
        else:
            turn, shift, K = self.rotations[which], self.shifts[which], self.intrinsics[which]
            seen = np.einsum("pij,pj->pi", turn, points) + shift
        depth = np.maximum(seen[..., 2], _NEAR)
        slopes = seen[..., :2] / depth[..., None]
        # Intrinsics may have a skew, but their last row is (0, 0, 1).
        pixels = np.einsum("...ij,...j->...i", K[..., :2, :2], slopes) + K[..., :2, 2]
        by_seen = np.zeros((*depth.shape, 2, 3))
        by_seen[..., 0, 0] = by_seen[..., 1, 1] = 1 / depth
        by_seen[..., 2] = -slopes / depth[..., None]
        return Projection(pixels, seen[..., 2], K[..., :2, :2] @ by_seen @ turn)


class Occlusion:
    """Which points of a mesh cameras see.

    The surface is sampled every few millimetres and the nearest depth in every cell of `CELL` pixels is kept. This is
    a hundred times faster than drawing the mesh and as exact as robust estimates need.

    Parameters
    ----------
    head : HeadAsset
        Head model, for its triangles.
    neutral : FloatArray
        (V, 3) a mesh of the subject's size, metres.
    views : Views
        Cameras.
    """

    def __init__(self, head: HeadAsset, neutral: FloatArray, views: Views):
        self._faces, self._views = np.asarray(head.faces), views
        corners = self._faces
        # A triangle of area a holds 2 a / spacing^2 samples, at the centres of a grid of barycentric coordinates.
        number = np.ceil(np.sqrt(2 * triangle_areas(neutral, corners)) / _SPACING).clip(1, 8).astype(int)
        self._samples: list[tuple[IntArray, FloatArray]] = []
        for steps in np.unique(number):
            first, second = (axis.ravel() for axis in np.mgrid[:steps, :steps])
            kept = first + second < steps
            grid = (np.stack([first[kept], second[kept]], axis=1) + 1 / 3) / steps
            shares = np.concatenate([1 - grid.sum(axis=1, keepdims=True), grid], axis=1)
            self._samples.append((corners[number == steps], shares))

    def visible(self, mesh: FloatArray, vertices: IntArray) -> FloatArray:
        """(C, n) cosine between normal and direction to the camera at vertices that are seen, else 0.

        Parameters
        ----------
        mesh : FloatArray
            (V, 3) posed mesh, metres.
        vertices : IntArray
            (n,) vertices.
        """
        normals = vertex_normals(mesh, self._faces)[vertices]
        points = mesh[vertices]
        toward = self._views.centers[:, None] - points
        cosine = np.einsum("cni,ni->cn", toward, normals) / np.linalg.norm(toward, axis=2)
        surface = [mesh] + [
            np.einsum("sk,fki->fsi", shares, mesh[faces]).reshape(-1, 3) for faces, shares in self._samples
        ]
        nearest = self._buffer(np.concatenate(surface))
        projected = self._views.project(points)
        cells, inside = self._cells(projected.pixels)
        rows = np.arange(len(cosine))[:, None]
        seen = inside & (projected.depth < nearest[rows, cells] + MARGIN) & (cosine > FACING)
        return np.where(seen, cosine, 0.0)

    def _buffer(self, points: FloatArray) -> FloatArray:
        """(C, cells) nearest depth."""
        width, height = self._views.sizes.max(axis=0) // CELL + 1
        projected = self._views.project(points)
        cells, inside = self._cells(projected.pixels)
        count = width * height
        nearest = np.full((len(cells), count), np.inf)
        for camera, (row, kept) in enumerate(zip(cells, inside)):
            np.minimum.at(nearest[camera], row[kept], projected.depth[camera, kept])
        return nearest

    def _cells(self, pixels: FloatArray) -> tuple[IntArray, BoolArray]:
        """Cell of each point, (C, P), and whether it is in the image."""
        sizes = self._views.sizes[:, None]
        width, height = self._views.sizes.max(axis=0) // CELL + 1
        inside = ((pixels >= 0) & (pixels < sizes)).all(axis=2)
        at = np.clip(np.nan_to_num(pixels) // CELL, 0, [width - 1, height - 1]).astype(np.int64)
        return at[..., 1] * width + at[..., 0], inside
