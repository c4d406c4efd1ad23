"""Rays of a camera, in the world."""

from __future__ import annotations

import numpy as np

from ...bench.contracts import Camera, FloatArray
from .marching import Rays

Region = tuple[int, int, int, int]  # left, top, right, bottom; the last two excluded


def camera_rays(camera: Camera, columns: np.ndarray, rows: np.ndarray, jitter: np.ndarray | float) -> Rays:
    """Rays through the centres of (R,) pixels, from the camera's centre; ``jitter`` as in `Rays`."""
    K = np.asarray(camera.K, np.float64)
    y = (rows + 0.5 - K[1, 2]) / K[1, 1]
    x = (columns + 0.5 - K[0, 2] - K[0, 1] * y) / K[0, 0]
    towards = np.stack([x, y, np.ones_like(x)], axis=1)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    directions = towards @ camera.world_to_camera[:3, :3]
    origins = np.broadcast_to(camera.center, directions.shape)
    shift = np.broadcast_to(np.asarray(jitter, np.float32), len(directions))
    return Rays(origins.astype(np.float32), directions.astype(np.float32), np.ascontiguousarray(shift))


def pixels_of_hull(camera: Camera, points: FloatArray) -> Region:
    """Pixels outside of which no ray meets the convex hull of (N, 3) points; the whole image if any is behind."""
    transform = np.asarray(camera.world_to_camera, np.float64)
    seen = np.asarray(points, np.float64) @ transform[:3, :3].T + transform[:3, 3]
    if seen[:, 2].min() <= 1e-6:
        return 0, 0, camera.width, camera.height
    pixels = (seen @ np.asarray(camera.K, np.float64).T)[:, :2] / seen[:, 2:]
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(0) - 1), 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(0) + 1), 0, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def box_corners(points: FloatArray, padding: float) -> FloatArray:
    """(8, 3) corners of the box around points, grown by ``padding`` metres."""
    low, high = points.min(0) - padding, points.max(0) + padding
    return np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
