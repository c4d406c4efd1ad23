"""Implicit-surface vocabulary of the sculpture: primitives, smooth booleans and clay strokes.

Every function works on points ``(N, 3)`` in metres and returns ``(N,)`` approximate signed distances,
negative inside. The bounds are those of I. Quilez, "Distance functions" and "Smooth minimum".
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import wraps

import numpy as np
from scipy.interpolate import CubicSpline

from ....bench.contracts import FloatArray

Point = Sequence[float]


def rotation_xyz(degrees: Point) -> FloatArray:
    """(3, 3) rotation about x, then y, then z; the angles are in degrees."""
    (a, b, c) = np.radians(np.asarray(degrees, float))
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def local(points: FloatArray, center: Point, degrees: Point | None = None) -> FloatArray:
    """Points in the frame at ``center``, turned by ``degrees`` (see `rotation_xyz`)."""
    relative = points - np.asarray(center, points.dtype)
    return relative if degrees is None else relative @ rotation_xyz(degrees).astype(points.dtype)


def ellipsoid(points: FloatArray, center: Point, radii: Point, degrees: Point | None = None) -> FloatArray:
    """Ellipsoid; exact on the surface and first-order right near it."""
    scaled = local(points, center, degrees) / np.asarray(radii, points.dtype)
    length = np.linalg.norm(scaled, axis=1)
    slope = np.linalg.norm(scaled / np.asarray(radii, points.dtype), axis=1)
    return length * (length - 1) / np.maximum(slope, 1e-6)


def capsule(points: FloatArray, a: Point, b: Point, radius_a: float, radius_b: float) -> FloatArray:
    """Capsule between two points whose radius runs linearly from ``radius_a`` to ``radius_b``."""
    start = np.asarray(a, points.dtype)
    axis = np.asarray(b, points.dtype) - start
    relative = points - start
    along = np.clip(relative @ axis / (axis @ axis), 0, 1)
    distance = np.linalg.norm(relative - along[:, None] * axis, axis=1)
    return distance - (radius_a + along * (radius_b - radius_a))


def tube(points: FloatArray, knots: Sequence[Point], radii: Point, samples: int = 12) -> FloatArray:
    """Tube of varying radius along the cubic spline through ``knots``."""
    path = resample(np.column_stack([np.asarray(knots, float), np.asarray(radii, float)]), samples)
    pieces = [capsule(points, a[:3], b[:3], float(a[3]), float(b[3])) for a, b in itertools.pairwise(path)]
    return np.minimum.reduce(pieces)


def resample(knots: FloatArray, samples: int) -> FloatArray:
    """``samples`` rows at equal parameter steps on the chord-length cubic spline through ``knots``."""
    knots = np.asarray(knots, float)
    chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(knots[:, :3], axis=0), axis=1))])
    return CubicSpline(chord / chord[-1], knots)(np.linspace(0, 1, samples))


def union(a: FloatArray, b: FloatArray, blend: float) -> FloatArray:
    """Smooth union (quadratic smooth minimum); ``blend`` metres is the width of the fillet."""
    overlap = np.maximum(blend - np.abs(a - b), 0)
    return np.minimum(a, b) - overlap**2 / (4 * blend)


def intersection(a: FloatArray, b: FloatArray, blend: float) -> FloatArray:
    """Smooth intersection; the convex edge is rounded over ``blend`` metres."""
    return -union(-a, -b, blend)


def subtraction(a: FloatArray, b: FloatArray, blend: float) -> FloatArray:
    """``a`` without ``b``, the edge rounded over ``blend`` metres."""
    return intersection(a, -b, blend)


def stroke(points: FloatArray, center: Point, sigma: Point, degrees: Point | None = None) -> FloatArray:
    """Weight in [0, 1] of a Gaussian clay stroke: subtract ``height * stroke`` to add clay."""
    scaled = local(points, center, degrees) / np.asarray(sigma, points.dtype)
    return np.exp(-0.5 * np.einsum("ij,ij->i", scaled, scaled))


def ridge(points: FloatArray, knots: Sequence[Point], width: float, samples: int = 10) -> FloatArray:
    """Weight in [0, 1] of a stroke along a spline: Gaussian of its distance, of deviation ``width``."""
    distance = tube(points, knots, [0.0] * len(knots), samples)
    return np.exp(-0.5 * (distance / width) ** 2)


Feature = Callable[[FloatArray, FloatArray], FloatArray]


def within(low: Point, high: Point) -> Callable[[Feature], Feature]:
    """Decorate ``feature(head, points) -> head`` to touch only a box, which must hold all it changes."""

    def decorate(feature: Feature) -> Feature:
        @wraps(feature)
        def bounded(head: FloatArray, points: FloatArray) -> FloatArray:
            inside = np.all((points > np.asarray(low)) & (points < np.asarray(high)), axis=1)
            if not inside.any():
                return head
            changed = head.copy()
            changed[inside] = feature(head[inside], points[inside])
            return changed

        return bounded

    return decorate
