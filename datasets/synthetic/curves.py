"""Distances to points, polylines and polygons: the brushes that skin, hair and wrinkles are painted with."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from skimage.measure import points_in_poly

from ...bench.contracts import FloatArray


def blob(points: FloatArray, center: FloatArray, radius: float | FloatArray) -> FloatArray:
    """Gaussian of standard deviation ``radius`` (a number or one per axis) about ``center``; 1 in the middle."""
    return np.exp(-0.5 * (((points - center) / np.asarray(radius)) ** 2).sum(axis=-1))


def polyline_distance(points: FloatArray, line: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance to a polyline and the place of the nearest point on it.

    ``points`` (N, D), ``line`` (M, D) -> distances (N,) and arc-length shares (N,) in [0, 1].
    """
    best, place = np.full(len(points), np.inf), np.zeros(len(points))
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    start = np.concatenate([[0.0], np.cumsum(lengths)])
    for index, length in enumerate(lengths):
        if length == 0.0:
            continue
        direction = (line[index + 1] - line[index]) / length
        t = np.clip((points - line[index]) @ direction, 0.0, length)
        distance = np.linalg.norm(points - line[index] - t[:, None] * direction, axis=1)
        nearer = distance < best
        best = np.where(nearer, distance, best)
        place = np.where(nearer, (start[index] + t) / start[-1], place)
    return best, place


def polygon_distance(points: FloatArray, outline: FloatArray) -> FloatArray:
    """Signed distance of (N, 2) points to a closed (M, 2) outline, negative inside."""
    closed = np.concatenate([outline, outline[:1]])
    distance, _ = polyline_distance(points, closed)
    return np.where(points_in_poly(points, outline), -distance, distance)


def smooth_curve(anchors: FloatArray, count: int) -> FloatArray:
    """``count`` points along a Catmull-Rom-like cubic through (M, D) anchors."""
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(anchors, axis=0), axis=1))])
    return CubicSpline(chord / chord[-1], anchors, bc_type="natural")(np.linspace(0.0, 1.0, count))
