"""Distances to points, polylines and polygons, and noise, from which skin, hair and wrinkles are painted."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from skimage.measure import points_in_poly

from ...bench.contracts import FloatArray, IntArray


def blob(points: FloatArray, center: FloatArray, radius: float | FloatArray) -> FloatArray:
    """Gaussian of standard deviation ``radius`` (a number or one per axis) about ``center``; 1 in the middle."""
    return np.exp(-0.5 * (((points - center) / np.asarray(radius)) ** 2).sum(axis=-1))


def polyline_distance(points: FloatArray, line: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance to a polyline and the arc-length position of the nearest point on it.

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


# Odd constants of the usual integer mixers (one per axis, one per seed).
_MIX = (np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F), np.uint64(0x165667B19E3779F9))
_SEED_MIX = np.uint64(0xD6E8FEB86659FD93)


def lattice_value(cells: IntArray, seed: int) -> FloatArray:
    """Hash integer points (..., 3) to floats in [0, 1) (a splitmix-like finaliser)."""
    with np.errstate(over="ignore"):
        state = np.full(cells.shape[:-1], seed, np.uint64) * _SEED_MIX
        for axis, factor in enumerate(_MIX):
            state = state ^ (cells[..., axis].astype(np.int64).view(np.uint64) * factor)
            state = (state ^ (state >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
        state = state ^ (state >> np.uint64(32))
    return (state >> np.uint64(11)).astype(np.float64) / float(1 << 53)


def value_noise(points: FloatArray, seed: int) -> FloatArray:
    """Trilinear value noise with smooth weights, lattice spacing 1; (N, 3) -> (N,) in [-1, 1]."""
    base = np.floor(points).astype(np.int64)
    t = points - base
    weight = t * t * (3.0 - 2.0 * t)
    total = np.zeros(len(points))
    for corner in range(8):
        bits = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        share = np.prod(np.where(bits, weight, 1.0 - weight), axis=-1)
        total += share * lattice_value(base + bits, seed)
    return 2.0 * total - 1.0


def fractal_noise(points: FloatArray, period: float, seed: int, octaves: int = 4) -> FloatArray:
    """Sum of octaves of value noise, each of half the period and amplitude; about [-1, 1].

    ``period`` is the largest lattice spacing, in the unit of ``points``.
    """
    total, amplitude, norm = np.zeros(len(points)), 1.0, 0.0
    for octave in range(octaves):
        total += amplitude * value_noise(points * (2.0**octave / period) + 17.3 * octave, seed + octave)
        norm += amplitude
        amplitude *= 0.5
    return total / norm


def spots(points: FloatArray, spacing: float, radius: float, share: float, seed: int) -> FloatArray:
    """Round spots scattered in space, (N,) in [0, 1]: 1 in a spot's middle.

    One spot at most per cell of a lattice of ``spacing``, in a ``share`` of the cells, with radii of
    ``radius`` times 0.5 to 1.5.
    """
    base = np.floor(points / spacing).astype(np.int64)
    best = np.zeros(len(points))
    for offset in np.ndindex(3, 3, 3):
        cell = base + np.array(offset) - 1
        jitter = np.stack([lattice_value(cell, seed + axis) for axis in (1, 2, 3)], axis=-1)
        present = lattice_value(cell, seed + 4) < share
        size = radius * (0.5 + lattice_value(cell, seed + 5))
        distance = np.linalg.norm(points - (cell + jitter) * spacing, axis=-1)
        best = np.maximum(best, present * np.clip(1.5 - 1.5 * distance / size, 0.0, 1.0))
    return np.minimum(best, 1.0)
