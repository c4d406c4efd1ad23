"""Movements of the lids: the skin around the eye turns about the eyeball and never enters it."""

from __future__ import annotations

import numpy as np

from ...bench.contracts import FloatArray
from .anatomy import EYE_CENTER, EYE_RADIUS, eye_front, lid_curves
from .rig import smoothstep
from .surface import Surface

MEETING = 0.14  # where closing lids meet: share of the way from the lower to the upper margin
LID_DEPTH = 0.0009  # height over the eyeball of the middle of a lid's margin


def margin_angles(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles about the x axis of the eye, from straight ahead and up, of the upper and lower margin at ``x``."""
    angles = []
    for height in lid_curves(x):
        point = eye_front(x, height, LID_DEPTH) - EYE_CENTER
        angles.append(np.arctan2(point[:, 1], point[:, 2]))
    return angles[0], angles[1]


def lid_turn(surface: Surface, upper: FloatArray | float, lower: FloatArray | float) -> FloatArray:
    """(V, 3) displacement that turns the margins of the left eye's lids.

    Parameters
    ----------
    surface : the surface at rest.
    upper, lower : radians by which each margin turns, positive up; a number, or one for each vertex.
    """
    relative = surface.vertices - EYE_CENTER
    x, y, z = relative.T
    top, bottom = margin_angles(x)
    middle = (top + bottom) / 2
    angle = np.arctan2(y, z)
    on_upper = angle > middle
    beyond = np.where(on_upper, angle - top, bottom - angle)
    radius = np.hypot(y, z)
    over = np.linalg.norm(relative, axis=1) - EYE_RADIUS
    skin = surface.skin * (surface.vertices[:, 0] > 0)
    # A lid moves as one along its margin; its skin is drawn from the fold below the brow, or from the cheek.
    along = 1 - smoothstep(beyond, 0.12, np.where(on_upper, 0.85, 0.70))
    across = 1 - smoothstep(over, 0.0040, 0.0110)
    sideways = 1 - smoothstep(np.abs(x), 0.0150, 0.0220)
    turn = np.where(on_upper, upper, lower) * along * across * sideways * skin
    moved = np.column_stack([x, radius * np.sin(angle + turn), radius * np.cos(angle + turn)])
    return keep_off_eyes(surface, np.where(skin[:, None] > 0, moved - relative, 0))


def blink(surface: Surface) -> FloatArray:
    """(V, 3) displacement that closes the left eye."""
    x = surface.vertices[:, 0] - EYE_CENTER[0]
    top, bottom = margin_angles(x)
    opening = np.maximum(top - bottom, 0)
    closed = lid_turn(surface, -(1 - MEETING) * opening, MEETING * opening)
    # A shape moves along chords, which dip towards the eye half way: end a little proud of the ball.
    relative = surface.vertices + closed - EYE_CENTER
    distance = np.linalg.norm(relative, axis=1, keepdims=True)
    moved = np.linalg.norm(closed, axis=1, keepdims=True)
    return closed + relative / distance * np.minimum(0.09 * moved, 0.0006)


def keep_off_eyes(surface: Surface, field: FloatArray, clearance: float = 0.0003) -> FloatArray:
    """The displacement, pushed out wherever skin would enter an eyeball at rest by it."""
    held = field.copy()
    for ball in (EYE_CENTER, EYE_CENTER * [-1, 1, 1]):
        relative = surface.vertices + held - ball
        distance = np.linalg.norm(relative, axis=1)
        inside = (distance < EYE_RADIUS + clearance) & (surface.skin > 0)
        inside &= np.linalg.norm(field, axis=1) > 0
        push = (EYE_RADIUS + clearance) / np.maximum(distance, 1e-6)
        held[inside] = (ball + relative * push[:, None] - surface.vertices)[inside]
    return held
