"""Errors of an avatar's depth and normals in the face, compared with the true head."""

from __future__ import annotations

import math

import numpy as np

from ..contracts import Camera, FloatArray, TrueFrame
from .stability import LimitCheck

FACE = "face"
MEASURED = ("depth", "normals")
NO_DEPTH, NO_FACE = "the avatar gives no depth", "no face in view"
NOT_SHOWN = "the avatar shows nothing where the face is"


def surface(depth: FloatArray | None, truth: TrueFrame, camera: Camera) -> list[LimitCheck]:
    """Mean errors of depth (mm) and normals (degrees) over the pixels of the face that the avatar covers.

    Pixels of the face that the avatar does not cover are ignored here; they reduce the overlap of masks. There are no limits:
    translucent splats show a mean depth behind the skin, which images do not determine.

    Parameters
    ----------
    depth : FloatArray | None
        (H, W) metres along the camera's axis, NaN where nothing is shown; None for an avatar that gives none.
    truth : TrueFrame
        Ground truth with depth.
    camera : Camera
        Camera of the (H, W) images.
    """
    if depth is None:
        return absent_surface(NO_DEPTH)
    assert truth.depth is not None
    true = np.where(truth.face & np.isfinite(truth.depth), truth.depth, np.nan).astype(np.float64)
    depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float64)
    seen = np.isfinite(true) & np.isfinite(depth)
    if not seen.any():
        return absent_surface(NOT_SHOWN if np.isfinite(true).any() else NO_FACE)
    error = 1000 * np.abs(depth - true)[seen].mean()
    checks = [_measured("depth", float(error))]
    shown, right = normals(depth, camera), normals(true, camera)
    both = np.isfinite(shown).all(axis=2) & np.isfinite(right).all(axis=2)
    if not both.any():
        return [*checks, _measured("normals", None, NO_FACE)]
    cosines = np.clip((shown[both] * right[both]).sum(axis=1), -1.0, 1.0)
    return [*checks, _measured("normals", float(np.degrees(np.arccos(cosines)).mean()))]


def absent_surface(reason: str) -> list[LimitCheck]:
    """The measures of a frame without depth, with the reason."""
    return [_measured(name, None, reason) for name in MEASURED]


def _measured(name: str, value: float | None, reason: str = "") -> LimitCheck:
    return LimitCheck(name, value, -math.inf, math.inf, reason, FACE)


def normals(depth: FloatArray, camera: Camera) -> FloatArray:
    """(H, W, 3) unit normals, facing the camera, of an (H, W) depth map, by central differences; NaN next to missing depth."""
    rows, columns = np.indices(depth.shape) + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=2) @ np.linalg.inv(camera.K).T
    points = depth[..., None] * rays
    down, right = np.gradient(points, axis=(0, 1))
    found = np.cross(down, right)
    return np.asarray(found / np.linalg.norm(found, axis=2, keepdims=True))
