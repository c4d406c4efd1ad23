"""Movements of the lids: the skin around the eye turns about the eyeball and never enters it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

from ....bench.contracts import FloatArray
from ..geometry import mesh_edges, smoothstep
from .anatomy import EYE_CENTER, EYE_RADIUS, eye_front, lid_curves
from .surface import Surface

MEETING = 0.14  # where closing lids meet: share of the way from the lower to the upper margin
LID_DEPTH = 0.0009  # height over the eyeball of the middle of a lid's margin


def margin_angles(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles about the eye's x axis, from straight ahead and up, of the upper and lower margin at ``x``."""
    angles = []
    for height in lid_curves(x):
        point = eye_front(x, height, LID_DEPTH) - EYE_CENTER
        angles.append(np.arctan2(point[:, 1], point[:, 2]))
    return angles[0], angles[1]


def lid_turn(surface: Surface, upper: FloatArray | float, lower: FloatArray | float) -> FloatArray:
    """(V, 3) displacement that turns the margins of the left eye's lids.

    The margins, and the lids' inner sides, turn rigidly about the eyeball; the skin around follows by the
    harmonic field between the margins and what stays at rest.

    Parameters
    ----------
    surface : the surface at rest.
    upper, lower : radians by which each margin turns, positive up; a number, or one for each vertex.
    """
    relative = surface.vertices - EYE_CENTER
    x, y, z = relative.T
    top, bottom = margin_angles(x)
    angle = np.arctan2(y, z)
    on_upper = angle > (top + bottom) / 2
    beyond = np.where(on_upper, angle - top, bottom - angle)
    distance = np.linalg.norm(relative, axis=1)
    margin = (surface.skin > 0) & (beyond < 0.16) & (distance < EYE_RADIUS + 0.0030) & (np.abs(x) < 0.0165)
    inner = surface.in_socket & (surface.vertices[:, 0] > 0)
    fade = np.where(inner, 1 - smoothstep(beyond, 0.2, 1.2), 1) * (1 - smoothstep(np.abs(x), 0.0145, 0.0165))
    turn = np.where(on_upper, upper, lower) * fade
    radius = np.hypot(y, z)
    turned = np.column_stack([x, radius * np.sin(angle + turn), radius * np.cos(angle + turn)]) - relative
    held = margin | inner
    turned[~held] = 0
    free = (surface.skin > 0) & ~held & (np.linalg.norm(relative * [0.85, 1, 1], axis=1) < 0.021)
    return keep_off_eyes(surface, harmonic(surface, turned, free))


def harmonic(surface: Surface, field: FloatArray, free: NDArray[np.bool_]) -> FloatArray:
    """The field with its values at ``free`` vertices made the mean of their neighbours' (uniform weights)."""
    count = len(surface.vertices)
    edges = mesh_edges(surface.faces)
    pairs = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    adjacency = coo_matrix((np.ones(len(pairs)), pairs.T), (count, count)).tocsr()
    inside, known = np.flatnonzero(free), np.flatnonzero(~free)
    laplacian = diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency
    system = laplacian[inside][:, inside].tocsc()
    filled = field.copy()
    filled[inside] = splu(system).solve(-(laplacian[inside][:, known] @ field[known]))
    return filled


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
