"""Views of a head between its training cameras and beyond them, and its typical pose, which they face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..contracts import Camera, Clip, FloatArray, HeadPose
from ..errors import InputError

NEAR_M = 1e-6
NEAR_AXES = 1e-3
"""Weight of the distance to the head's centre relative to the axes of cameras, which may be a single axis or parallel."""
LEAST_SPREAD = 0.15
"""Minimum ratio of singular values of the cameras' right axes for deriving the upward direction from them."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A new view of the head: whether it lies beyond the outermost training cameras, and its azimuth in degrees about the
    upward axis, 0 at the mean training direction, positive to the camera's right."""

    camera: Camera
    extrapolated: bool
    azimuth: float


def training_poses(clip: Clip) -> list[HeadPose]:
    """Tracked poses of the training timesteps, in order."""
    return [clip.poses[t] for t in sorted({key.timestep for key in clip.splits["train"]})]


def typical_pose(poses: Sequence[HeadPose]) -> HeadPose:
    """The recorded pose whose expression is nearest to the mean; a real pose, so that its parts are consistent."""
    expressions = np.array([pose.expression for pose in poses], np.float64)
    return poses[int(np.argmin(np.linalg.norm(expressions - expressions.mean(axis=0), axis=1)))]


def head_center(clip: Clip) -> FloatArray:
    """(3,) centre of the head's bounding box in its typical training pose, metres."""
    head, pose = clip.head, typical_pose(training_poses(clip))
    coefficients = np.asarray(clip.shape, np.float64)
    shaped = head.template + head.shape_basis[..., : len(coefficients)] @ coefficients
    joint = head.joint_regressor[0] @ shaped
    rotation, _ = cv2.Rodrigues(np.asarray(pose.rotation, np.float64))
    middle = (shaped.min(axis=0) + shaped.max(axis=0)) / 2
    return np.asarray(rotation @ (middle - joint) + joint + pose.translation)


def turntable(
    cameras: Sequence[Camera], center: FloatArray, count: int, beyond_degrees: float
) -> list[Viewpoint]:
    """Views around a head through the directions of its training cameras, in even steps and order of azimuth.

    Between two cameras that are neighbours in azimuth, the direction from the head is interpolated along the great
    circle, the distance and the focal lengths linearly. Beyond the outermost two, elevation and distance are constant.
    If the cameras surround the head, with no gap wider than twice ``beyond_degrees``, no view is extrapolated.

    Parameters
    ----------
    cameras : Sequence[Camera]
        Training cameras, at least one; views have the size of the first.
    center : FloatArray
        (3,) point that the views face, metres.
    count : int
        Number of views, at least 1.
    beyond_degrees : float
        Maximum angle of views beyond the outermost cameras on either side, in [0, 180).
    """
    first = cameras[0]
    sized = [camera.resized(first.width, first.height) for camera in cameras]
    focal = np.array([[camera.K[0, 0], camera.K[1, 1]] for camera in sized])
    offsets = np.array([camera.center for camera in cameras]) - center
    distances = np.linalg.norm(offsets, axis=1)
    if distances.min() < NEAR_M:
        raise InputError("turntable", "cameras", "cameras away from the head", "one within it")
    directions = offsets / distances[:, None]
    axes = _axes(cameras, directions)
    local = directions @ axes.T  # right, up, front
    azimuths = np.degrees(np.arctan2(local[:, 0], local[:, 2]))

    order = np.argsort(azimuths, kind="stable")
    # The arc that covers all azimuths except the widest gap between two of them.
    gaps = np.diff(azimuths[order], append=azimuths[order[0]] + 360.0)
    widest = int(np.argmax(gaps))
    arc = float(360.0 - gaps[widest])
    order = np.roll(order, -(widest + 1))
    degrees = (azimuths[order] - azimuths[order[0]]) % 360.0  # relative to the start of the arc, increasing
    if 360.0 - arc <= 2.0 * beyond_degrees:
        order, degrees = np.append(order, order[0]), np.append(degrees, 360.0)
        steps = np.arange(count) * 360.0 / count
    elif count > 1:
        steps = np.linspace(-beyond_degrees, arc + beyond_degrees, count)
    else:
        steps = np.array([arc / 2])
    local, distances, focal = local[order], distances[order], focal[order]

    views = []
    for index, step in enumerate(steps):
        inside = float(np.clip(step, 0.0, degrees[-1]))
        upper = int(np.clip(np.searchsorted(degrees, inside), 1, max(len(degrees) - 1, 1)))
        lower = upper - 1
        upper = min(upper, len(degrees) - 1)
        width = degrees[upper] - degrees[lower]
        share = (inside - degrees[lower]) / width if width > 0 else 0.0
        right, height, front = _slerp(local[lower], local[upper], share)
        sin, cos = np.sin(np.radians(step - inside)), np.cos(np.radians(step - inside))
        direction = np.array([cos * right + sin * front, height, cos * front - sin * right])
        distance = (1 - share) * distances[lower] + share * distances[upper]
        fx, fy = (1 - share) * focal[lower] + share * focal[upper]
        K = np.array([[fx, 0.0, first.width / 2], [0.0, fy, first.height / 2], [0.0, 0.0, 1.0]])
        pose = look_at(center + distance * (direction @ axes), center, axes[1])
        views.append(
            Viewpoint(
                Camera(f"turntable-{index:02d}", first.width, first.height, K, pose),
                extrapolated=bool(abs(step - inside) > 1e-9),
                azimuth=float(np.degrees(np.arctan2(direction[0], direction[2]))),
            )
        )
    return views


def common_target(cameras: Sequence[Camera], center: FloatArray) -> FloatArray:
    """(3,) point that the cameras face, metres: nearest to all of their axes; if ambiguous, the one nearest to ``center`` (3,).

    Views that face it have the framing of the training images.
    """
    matrix, wanted = NEAR_AXES * np.eye(3), NEAR_AXES * np.asarray(center, np.float64)
    for camera in cameras:
        axis = camera.world_to_camera[2, :3]
        across = (np.eye(3) - np.outer(axis, axis)) / len(cameras)
        matrix, wanted = matrix + across, wanted + across @ camera.center
    return np.asarray(np.linalg.solve(matrix, wanted))


def look_at(position: FloatArray, target: FloatArray, up: FloatArray) -> FloatArray:
    """(4, 4) world-to-camera motion, OpenCV axes, of a camera that faces ``target`` with ``up`` upwards."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:  # straight from above or below: any right axis is valid
        right = np.cross(forward, np.roll(up, 1) + np.array([1e-3, 0.0, 0.0]))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, -rotation @ position
    return motion


def _axes(cameras: Sequence[Camera], directions: FloatArray) -> FloatArray:
    """(3, 3) rows right, up, front of the rig in the world: front is the mean direction of the cameras."""
    up = _up(cameras)
    front = directions.mean(axis=0)
    front = front - (front @ up) * up
    if np.linalg.norm(front) < 1e-6:  # all around: use the direction of any camera
        front = directions[0] - (directions[0] @ up) * up
    if np.linalg.norm(front) < 1e-6:
        front = np.cross(cameras[0].world_to_camera[0, :3], up)
    front = front / np.linalg.norm(front)
    return np.stack([np.cross(up, front), up, front])


def _up(cameras: Sequence[Camera]) -> FloatArray:
    """(3,) upward direction of the world: normal to the image rows, since cameras pitch but hardly roll.

    For cameras with parallel rows it is the mean of their own upward directions.
    """
    mean = -np.mean([camera.world_to_camera[1, :3] for camera in cameras], axis=0)
    if np.linalg.norm(mean) < 1e-6:
        mean = -cameras[0].world_to_camera[1, :3]
    _, spread, axes = np.linalg.svd(np.array([camera.world_to_camera[0, :3] for camera in cameras]))
    if len(cameras) > 1 and spread[1] > LEAST_SPREAD * spread[0]:
        return np.asarray(axes[2] * (1.0 if axes[2] @ mean >= 0 else -1.0))
    return np.asarray(mean / np.linalg.norm(mean))


def _slerp(a: FloatArray, b: FloatArray, share: float) -> FloatArray:
    angle = np.arccos(np.clip(a @ b, -1.0, 1.0))
    if np.sin(angle) < 1e-9:
        return a
    mixed = (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)
    return np.asarray(mixed / np.linalg.norm(mixed))
