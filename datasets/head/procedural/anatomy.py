"""Anatomy of the sculpted head: positions, curves and frames shared by the sculptor and the rig.

Metres, +y up, +z front, subject's left at +x. Every curve is given for the left half; the right one is its
mirror image. Proportions follow adult means of Farkas, "Anthropometry of the Head and Face" (1994).
"""

from __future__ import annotations

import numpy as np

from ....bench.contracts import FloatArray

FLOOR = -0.19  # height of the flat cut at the base of the neck

EYE_CENTER = np.array([0.0315, 0.0200, 0.0535])
EYE_RADIUS = 0.0120
LID_CLEARANCE = 0.0004  # between the eyeball and the inner side of the lids
MEDIAL_CANTHUS = -0.0138  # along x from the centre of the eye
LATERAL_CANTHUS = 0.0132
UPPER_LID_HEIGHT = 0.0062  # above the line through the canthi
LOWER_LID_DEPTH = 0.0046

MOUTH_HALF_WIDTH = 0.0258
MOUTH_CAVITY = ((0.0, -0.0500, 0.0400), (0.0265, 0.0160, 0.0305))  # ellipsoid: centre, radii
SCULPTED_LIP_GAP = 0.0024  # the mouth is sculpted slightly open, to separate the lips
CLOSED_LIP_GAP = 0.0003  # gap left by `close_mouth`
LIP_RING_HEIGHT = (
    0.0025  # heights of the rings of the lips above and below the closed slit: on the red, just outside
)
LIP_RING_REACH = 0.93  # where the rings end, in half widths of the mouth


def canthal_height(x: FloatArray | float) -> FloatArray | float:
    """Height of the line through the canthi above the centre of the eye, at ``x`` from the centre."""
    return -0.0004 + 0.055 * x


def lid_curves(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Heights of the upper and lower lid margin above the centre of the eye, at ``x`` from the centre.

    The curves cross at the canthi, so that the aperture closes.
    """
    middle = (MEDIAL_CANTHUS + LATERAL_CANTHUS) / 2
    half = (LATERAL_CANTHUS - MEDIAL_CANTHUS) / 2
    u = (x - middle) / half
    line = canthal_height(x)
    # The upper margin peaks a little medially, the lower one sags laterally.
    upper = (1 - u**2) * (1 + 0.22 * u**2) * (1 - 0.14 * u)
    lower = (1 - u**2) * (1 + 0.25 * u**2) * (1 + 0.22 * u)
    return line + UPPER_LID_HEIGHT * upper, line - LOWER_LID_DEPTH * lower


def slit_height(x: FloatArray) -> FloatArray:
    """Height of the line between the lips at distance ``x`` from the midline: a flat cupid's bow."""
    u = np.abs(x) / MOUTH_HALF_WIDTH
    return -0.0512 - 0.0008 * np.exp(-((u / 0.16) ** 2)) - 0.0012 * u**3


def lip_arc(x: FloatArray) -> FloatArray:
    """Depth z of the line between the lips at ``x``: it follows the dental arch."""
    return 0.0785 - 17.0 * x**2


def eye_front(x: FloatArray, y: FloatArray, height: float) -> FloatArray:
    """(N, 3) points over the left eyeball at (x, y) from its centre, ``height`` above its surface."""
    depth = np.sqrt(np.maximum((EYE_RADIUS + height) ** 2 - x**2 - y**2, 1e-8))
    return np.column_stack([x, y, depth]) + EYE_CENTER


def close_mouth(vertices: FloatArray) -> FloatArray:
    """Close the lips of the head, which is sculpted with an open mouth; smooth, and the identity elsewhere."""
    x, y, z = vertices.T
    above = y - slit_height(x)
    lift = (SCULPTED_LIP_GAP - CLOSED_LIP_GAP) / 2
    along = np.clip((np.abs(x) - MOUTH_HALF_WIDTH) / 0.003, 0, 1)
    behind = np.clip((0.058 - z) / 0.010, 0, 1)
    fade = np.exp(-((np.maximum(np.abs(above) - 0.001, 0) / 0.009) ** 2)) * (1 - along) * (1 - behind)
    closed = vertices.copy()
    closed[:, 1] -= np.sign(above) * np.minimum(lift, np.abs(above)) * fade
    return closed


def lip_contour(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Heights of the upper and lower border of the lips' red at distance ``x`` >= 0 from the midline."""
    u = np.clip(x / MOUTH_HALF_WIDTH, 0, 1)
    bow = -0.0006 * np.exp(-((u / 0.10) ** 2)) + 0.0006 * np.exp(-(((u - 0.19) / 0.09) ** 2))
    line = slit_height(x)
    return line + 0.0072 * (1 - u**1.7) + bow + 0.0004, line - 0.0098 * (1 - u**2.4) - 0.0004
