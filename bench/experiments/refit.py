"""Test frames fitted to themselves: the tracking of each scored frame is refined on its own picture, the avatar is frozen.

Some authors do so before they score a frame (FATE for the data of IMavatar, 50 steps). Such values measure how well an avatar can
show a known picture, not how well it follows a driving signal, and are not comparable with the plain ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..contracts import Avatar, ByteArray, Camera, Clip, FloatArray, FrameKey, HeadPose
from ..io.images import quantise
from .extremes import PoseComponents
from .viewpoints import head_center, training_poses

UNITS = np.array([0.05] * 3 + [0.005] * 3 + [0.05] * 3)
"""Changes of rotation, translation and jaw (radians, metres, radians) of the same weight as one standard deviation of expression."""
LEVEL = 1 / 255
"""Differences far above it count by their absolute value, as in FATE, so that shoulders and hair do not outweigh the face."""
PRIOR = 1e-4
"""Mean difference by which the fit has to fall for a change of one unit, so that pictures decide wherever they show anything."""
DIFFERENCE = 0.1
"""Step of finite differences, in units."""
STEPS = (1.0, 0.3, 0.1)
"""Parts of a Gauss-Newton step that are tried until the error falls."""


@dataclass(frozen=True, eq=False)
class FrameFit:
    """Fit of the view of one frame to its picture, through `Avatar.render` alone.

    The (9 + D,) parameters in units are rotation and translation of the head against the camera, the jaw, and the D largest
    `PoseComponents` of training.
    """

    avatar: Avatar
    camera: Camera
    pose: HeadPose
    picture: ByteArray
    background: tuple[float, ...]
    centre: FloatArray
    directions: FloatArray

    def view(self, parameters: FloatArray) -> tuple[Camera, HeadPose]:
        """The changed view. It has no timestep, since avatars may replace the tracking of timesteps that they know."""
        turn, shift, jaw = np.split(UNITS * parameters[: len(UNITS)], 3)
        motion = np.eye(4)
        motion[:3, :3] = cv2.Rodrigues(turn)[0]
        motion[:3, 3] = self.centre + shift - motion[:3, :3] @ self.centre
        camera = replace(self.camera, world_to_camera=self.camera.world_to_camera @ motion)
        along = parameters[len(UNITS) :] @ self.directions
        expression, jaw = self.pose.expression + along[:-3], self.pose.jaw + jaw + along[-3:]
        dtype = self.pose.expression.dtype
        return camera, replace(
            self.pose, expression=expression.astype(dtype), jaw=jaw.astype(dtype), timestep=None
        )

    def residuals(self, parameters: FloatArray, size: int) -> FloatArray:
        """Differences between render and picture, one for each pixel and channel.

        Both are reduced to at most ``size`` pixels; avatars are not rendered smaller, since splats grow relative to pixels.
        """
        camera, pose = self.view(parameters)
        scale = min(1.0, size / max(camera.width, camera.height))
        sides = (max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
        difference = (
            self.avatar.render(camera, pose, self.background).rgb - self.picture.astype(np.float32) / 255
        )
        reduced = cv2.resize(difference, sides, interpolation=cv2.INTER_AREA)
        return np.asarray(reduced.ravel(), np.float64)

    def scored(self, view: tuple[Camera, HeadPose]) -> float:
        """Mean square of the differences of the 8-bit frame at the size of the picture, as metrics see it."""
        rgb = self.avatar.render(*view, self.background).rgb
        return float(np.mean((quantise(rgb).astype(np.float64) - self.picture) ** 2))

    def error(self, residuals: FloatArray, parameters: FloatArray) -> float:
        """Mean absolute difference, smooth at 0, with the prior."""
        return float(np.hypot(residuals, LEVEL).mean() + PRIOR * parameters @ parameters)

    def fitted(self, iterations: int, size: int) -> FloatArray:
        """Parameters after reweighted Gauss-Newton steps with finite differences; the error never rises."""
        at = np.zeros(len(UNITS) + len(self.directions))
        residuals = self.residuals(at, size)
        for _ in range(iterations):
            changed = [self.residuals(at + DIFFERENCE * unit, size) for unit in np.eye(len(at))]
            slopes = (np.array(changed) - residuals) / DIFFERENCE
            weighted = slopes / np.hypot(residuals, LEVEL) / len(residuals)
            curvature = weighted @ slopes.T + 2 * PRIOR * np.eye(len(at))
            step = np.linalg.solve(curvature, weighted @ residuals + 2 * PRIOR * at)
            for part in STEPS:
                tried = at - part * step
                found = self.residuals(tried, size)
                if self.error(found, tried) < self.error(residuals, at):
                    at, residuals = tried, found
                    break
            else:
                break
        return at


def refit(
    avatar: Avatar,
    clip: Clip,
    key: FrameKey,
    background: tuple[float, ...],
    *,
    directions: int = 20,
    iterations: int = 3,
    size: int = 256,
) -> tuple[Camera, HeadPose]:
    """Fit camera, jaw and expression of a scored frame to its own picture; the registered change "test-refit".

    The mean absolute difference is minimised. The tracked view is kept if the fitted one does not have a higher PSNR, too.

    Parameters
    ----------
    directions : int
        Number of principal components of expression and jaw over the training poses that are fitted, at most.
    iterations : int
        Number of Gauss-Newton iterations, at most.
    size : int
        Longer side in pixels to which frames are reduced before they are compared during the iterations.
    """
    poses, tracked = training_poses(clip), (clip.cameras[key.camera], clip.poses[key.timestep])
    along = PoseComponents.of(poses, directions).directions
    frame = FrameFit(avatar, *tracked, clip.image(key), background, head_center(clip), along)
    fitted = frame.view(frame.fitted(iterations, size))
    return fitted if frame.scored(fitted) < frame.scored(tracked) else tracked
