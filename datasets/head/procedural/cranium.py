"""The mass of the head: cranium, face, jaw, neck and the beginning of the shoulders, before any feature."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator

from ....bench.contracts import FloatArray
from .fields import capsule, ellipsoid, intersection, stroke, tube, union

# One row per height, metres: midline depth of the face without nose and lips, half width, depth of the widest
# place, exponent of the superellipse that joins them.
FACE_SECTIONS = np.array(
    [
        # y, front, half width, widest at, exponent
        [0.080, 0.0650, 0.0600, 0.000, 2.10],
        [0.060, 0.0690, 0.0625, 0.002, 2.05],
        [0.042, 0.0705, 0.0640, 0.004, 2.00],
        [0.020, 0.0660, 0.0655, 0.006, 2.05],
        [0.000, 0.0690, 0.0665, 0.008, 2.10],
        [-0.020, 0.0730, 0.0640, 0.006, 2.10],
        [-0.035, 0.0765, 0.0610, 0.004, 2.05],
        [-0.050, 0.0780, 0.0565, 0.002, 2.00],
        [-0.068, 0.0730, 0.0500, 0.002, 2.05],
        [-0.082, 0.0745, 0.0430, 0.006, 2.10],
        [-0.095, 0.0720, 0.0370, 0.012, 2.10],
        [-0.115, 0.0600, 0.0300, 0.015, 2.00],
    ]
)


def face_mass(points: FloatArray) -> FloatArray:
    """Face from brow to chin: superelliptic sections over height, cut below by the plane of the jaw."""
    x, y, z = points.T
    rows = FACE_SECTIONS[::-1]
    front, half, widest, power = PchipInterpolator(rows[:, 0], rows[:, 1:])(
        np.clip(y, rows[0, 0], rows[-1, 0])
    ).T.astype(points.dtype)
    u = np.abs(x) / half + 1e-6
    v = np.maximum(z - widest, 0) / (front - widest) + 1e-6
    radius = (u**power + v**power) ** (1 / power)
    slope = np.hypot((u / radius) ** (power - 1) / half, (v / radius) ** (power - 1) / (front - widest))
    section = (radius - 1) / np.maximum(slope, 1e-3)
    below = -0.900 * (y + 0.0960) - 0.436 * (z - 0.058)
    behind = -0.010 - z
    top = y - 0.075
    jaw = intersection(section, below, 0.016)
    return intersection(intersection(jaw, behind, 0.030), top, 0.030)


def neck_mass(points: FloatArray) -> FloatArray:
    """Neck with sternomastoid and larynx, and the slope of the shoulders."""
    mirrored = np.column_stack([np.abs(points[:, 0]), points[:, 1:]])
    neck = tube(
        points,
        [(0, -0.030, -0.038), (0, -0.090, -0.042), (0, -0.150, -0.049), (0, -0.210, -0.056)],
        [0.050, 0.0515, 0.055, 0.064],
        samples=6,
    )
    trapezius = tube(
        mirrored,
        [(0.015, -0.060, -0.078), (0.030, -0.120, -0.082), (0.060, -0.175, -0.078), (0.085, -0.215, -0.070)],
        [0.020, 0.022, 0.026, 0.030],
        samples=6,
    )
    mass = union(neck, trapezius, 0.04)
    sternomastoid = capsule(mirrored, (0.058, -0.028, -0.030), (0.016, -0.195, 0.004), 0.008, 0.0065)
    mass = union(mass, sternomastoid, 0.018)
    mass -= 0.0030 * stroke(points, (0, -0.128, 0.006), (0.009, 0.012, 0.012))
    return mass


def head_mass(points: FloatArray) -> FloatArray:
    """Cranium, face and neck joined."""
    skull = ellipsoid(points, (0, 0.052, -0.019), (0.0765, 0.083, 0.0950))
    occiput = ellipsoid(points, (0, 0.030, -0.055), (0.062, 0.062, 0.056))
    skull = union(skull, occiput, 0.03)
    forehead = ellipsoid(points, (0, 0.062, 0.006), (0.060, 0.056, 0.0640))
    skull = union(skull, forehead, 0.03)
    head = union(skull, face_mass(points), 0.022)
    return union(head, neck_mass(points), 0.022)
