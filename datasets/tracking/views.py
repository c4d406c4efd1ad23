"""Cameras as arrays: projection with derivatives, and visibility by a coarse depth buffer.

Blurred images of all frames, sampled with their gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...bench.contracts import BoolArray, ByteArray, Camera, FloatArray, HeadAsset, IntArray
from ..head.geometry import triangle_areas, vertex_normals


class FrameStack:
    """Images of N frames as one row of pixels. ``images``: (H, W, 3) 8-bit images; sizes may differ."""

    def __init__(self, images: list[ByteArray]):
        self._images = images
        self.sizes = np.array([[image.shape[1], image.shape[0]] for image in images])
        counts = self.sizes.prod(axis=1)
        self._starts = np.concatenate([[0], np.cumsum(counts)])
        self._pixels = np.zeros((int(self._starts[-1]), 3), np.int16)

    def filter(self, sigma: float, wide: float = 0.0) -> None:
        """Blur the sampled images by ``sigma`` pixels, and subtract their blur by ``wide``; 0 for none. The difference
        contains less of slow changes such as shading, which turns with the head."""
        for start, image in zip(self._starts, self._images):
            levels: FloatArray = np.asarray(image * np.float32(_LEVELS / 255), np.float32)
            if sigma > 0:
                levels = _blurred(levels, sigma)
            if wide > 0:
                levels = levels - _blurred(levels, wide)
            flat = levels.reshape(-1, 3)
            self._pixels[start : start + len(flat)] = np.round(flat)

    def sample(self, frames: IntArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values (n, 3), 1 being white, and gradients (n, 3, 2) per pixel at places (n, 2) of frames (n,), bilinear.
        Places outside an image take its border."""
        sizes = self.sizes[frames]
        place = np.clip(pixels - 0.5, 0, sizes - 1.001)
        corner = place.astype(np.int64)
        x, y = (place - corner).astype(np.float32).T[..., None]
        width = sizes[:, 0]
        index = self._starts[frames] + corner[:, 1] * width + corner[:, 0]
        a, b, c, d = (
            self._pixels[at].astype(np.float32) for at in (index, index + 1, index + width, index + width + 1)
        )
        upper, lower = a + x * (b - a), c + x * (d - c)
        value = upper + y * (lower - upper)
        along = (b - a) + y * ((d - c) - (b - a))
        scale = np.float32(1 / _LEVELS)
        return value * scale, np.stack([along, lower - upper], axis=2) * scale


_LEVELS = 16384.0  # of stored values, so that blurred images are not rounded to 8 bits


def _blurred(levels: FloatArray, sigma: float) -> FloatArray:
    import cv2  # not everywhere where methods are trained

    return np.asarray(cv2.GaussianBlur(levels, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))


CELL = 4
"""Side of a cell of the depth buffer, pixels."""
MARGIN = 0.002
"""Depth tolerance, metres, in addition to the slope within a cell: a point is hidden if another surface is nearer by more."""
FACING = 0.25
"""Minimum cosine between the normal of a point and the direction to the camera."""
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
    """C cameras. ``cameras``: Cameras of any sizes."""

    def __init__(self, cameras: Sequence[Camera]):
        self.cameras = [*cameras]
        self.rotations = np.stack([camera.world_to_camera[:3, :3] for camera in cameras]).astype(np.float64)
        self.shifts = np.stack([camera.world_to_camera[:3, 3] for camera in cameras]).astype(np.float64)
        self.intrinsics = np.stack([camera.K for camera in cameras]).astype(np.float64)
        self.centers = np.stack([camera.center for camera in cameras])
        self.sizes = np.array([[camera.width, camera.height] for camera in cameras])

    def place(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (C, P, 2) and depth (C, P) of points (P, 3), in float32."""
        matrices = self.intrinsics @ np.concatenate([self.rotations, self.shifts[..., None]], axis=2)
        homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1).astype(np.float32)
        projected = homogeneous @ matrices.astype(np.float32).reshape(-1, 4).T  # (P, 3 C)
        projected = projected.reshape(len(points), -1, 3).transpose(1, 0, 2)
        depth = projected[..., 2]
        return projected[..., :2] / np.maximum(depth, _NEAR)[..., None], depth

    def project(self, points: FloatArray, which: IntArray | None = None) -> Projection:
        """Project points (P, 3), or with ``which`` (P,) each in the camera of that index, then without the axis C."""
        if which is None:
            turn, shift, K = self.rotations[:, None], self.shifts[:, None], self.intrinsics[:, None]
            seen = points @ self.rotations.transpose(0, 2, 1) + shift
        else:
            turn, shift, K = self.rotations[which], self.shifts[which], self.intrinsics[which]
            seen = np.einsum("pij,pj->pi", turn, points) + shift
        depth = np.maximum(seen[..., 2], _NEAR)
        slopes = seen[..., :2] / depth[..., None]
        # The last row of the intrinsics is (0, 0, 1); the first two multiply the slopes.
        linear = K[..., :2, :2]
        pixels = slopes[..., :1] * linear[..., 0] + slopes[..., 1:] * linear[..., 1] + K[..., :2, 2]
        by_point = turn[..., :2, :] - slopes[..., None] * turn[..., 2:, :]
        scaled = linear / depth[..., None, None]
        derivative = scaled[..., :1] * by_point[..., :1, :] + scaled[..., 1:] * by_point[..., 1:, :]
        return Projection(pixels, seen[..., 2], derivative)


class Occlusion:
    """Visibility of mesh points in cameras.

    The surface is sampled every few millimetres and the nearest depth in every cell of `CELL` pixels is kept. This is
    a hundred times faster than drawing the mesh and as exact as robust estimates need.

    ``head``: Head model, for its triangles. ``neutral``: (V, 3) a mesh of the subject's size, metres. ``views``: Cameras.
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
        """(C, n) cosine between normal and direction to the camera at vertices that are seen, else 0. ``mesh``: (V, 3)
        posed mesh, metres. ``vertices``: (n,) vertices."""
        normals = vertex_normals(mesh, self._faces)[vertices]
        points = mesh[vertices]
        toward = self._views.centers[:, None] - points
        cosine = np.einsum("cni,ni->cn", toward, normals) / np.linalg.norm(toward, axis=2)
        surface = [mesh] + [
            np.einsum("sk,fki->fsi", shares, mesh[faces]).reshape(-1, 3) for faces, shares in self._samples
        ]
        nearest = self._buffer(np.concatenate(surface))
        pixels, depth = self._views.place(points)
        cells, inside = self._cells(pixels)
        rows = np.arange(len(cosine))[:, None]
        slope = np.sqrt(1 - np.minimum(cosine**2, 1)) / np.maximum(cosine, FACING)
        margin = MARGIN + slope * CELL * depth / self._views.intrinsics[:, None, 0, 0]
        seen = inside & (depth < nearest[rows, cells] + margin) & (cosine > FACING)
        return np.where(seen, cosine, 0.0)

    def _buffer(self, points: FloatArray) -> FloatArray:
        """(C, cells) nearest depth."""
        width, height = self._views.sizes.max(axis=0) // CELL + 1
        pixels, depth = self._views.place(points)
        cells, inside = self._cells(pixels)
        count = width * height
        nearest = np.full((len(cells), count), np.inf, np.float32)
        for camera, (row, kept) in enumerate(zip(cells, inside)):
            np.minimum.at(nearest[camera], row[kept], depth[camera, kept])
        return nearest

    def _cells(self, pixels: FloatArray) -> tuple[IntArray, BoolArray]:
        """Cell of each point, (C, P), and whether it is in the image."""
        sizes = self._views.sizes[:, None]
        width, height = self._views.sizes.max(axis=0) // CELL + 1
        inside = (
            (pixels[..., 0] >= 0)
            & (pixels[..., 1] >= 0)
            & (pixels[..., 0] < sizes[..., 0])
            & (pixels[..., 1] < sizes[..., 1])
        )
        at = (pixels * np.float32(1 / CELL)).astype(np.int32)
        x, y = np.clip(at[..., 0], 0, width - 1), np.clip(at[..., 1], 0, height - 1)
        return y * width + x, inside
