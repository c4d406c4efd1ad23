"""The rigid motion of a head: taken out of poses, put back, or moved into the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...bench.contracts import Camera, Clip, FloatArray, HeadAsset, HeadPose
from .turns import axis_angle, matrices

_ROOT, _NECK = 0, 1


class SubjectHead:
    """A head with one identity, as far as rigid motion goes: where its root and neck joints are.

    Parameters
    ----------
    head : the model.
    shape : (S,) identity coefficients.
    static_offset : (V, 3) metres.
    """

    def __init__(self, head: HeadAsset, shape: FloatArray, static_offset: FloatArray):
        self.head = head
        self.canonical = neutral_head(head, shape, static_offset)
        regressor = np.asarray(head.joint_regressor[[_ROOT, _NECK]], dtype=np.float64)
        self._joints = regressor @ self.canonical
        self._by_expression = np.tensordot(regressor, np.asarray(head.expression_basis, dtype=np.float64), 1)

    @classmethod
    def of(cls, clip: Clip) -> SubjectHead:
        """The subject of a clip."""
        return cls(clip.head, clip.shape, clip.static_offset)

    def motion(self, pose: HeadPose) -> FloatArray:
        """(4, 4) rigid motion of the head: from the frame with the neck joint at rest to the world."""
        root, neck = self._joints + self._by_expression @ pose.expression
        turn_root, turn_neck = matrices(np.stack([pose.rotation, pose.neck]).astype(np.float64))
        matrix = np.eye(4)
        matrix[:3, :3] = turn_root @ turn_neck
        matrix[:3, 3] = turn_root @ (neck - turn_neck @ neck - root) + root + pose.translation
        return matrix

    def with_motion(self, pose: HeadPose, motion: FloatArray) -> HeadPose:
        """The pose with rotation and translation such that `motion` gives ``motion``; its neck stays."""
        turn_neck = matrices(np.asarray(pose.neck, dtype=np.float64)[None])[0]
        rotation = axis_angle(motion[:3, :3] @ turn_neck.T)
        turned = replace(pose, rotation=rotation, translation=np.zeros(3))
        return replace(turned, translation=motion[:3, 3] - self.motion(turned)[:3, 3])


def neutral_head(head: HeadAsset, shape: FloatArray, static_offset: FloatArray) -> FloatArray:
    """(V, 3) float64 unposed head of an identity, metres."""
    blend = np.asarray(head.shape_basis, dtype=np.float64) @ np.asarray(shape, dtype=np.float64)
    return np.asarray(head.template + blend + static_offset, dtype=np.float64)


def camera_in_head_frame(camera: Camera, pose: HeadPose, subject: SubjectHead) -> Camera:
    """The camera as the head sees it: the head's rigid motion moved into ``world_to_camera``.

    With the pose of `pose_in_head_frame` it shows the same picture. That is exact where ``pose.neck`` is zero
    (as a refit makes it by default); with a turned neck it is exact for what hangs on the neck joint, but the
    shoulders move along and the neck's pose correctives are lost.
    """
    return replace(camera, world_to_camera=camera.world_to_camera @ subject.motion(pose))


def pose_in_head_frame(pose: HeadPose) -> HeadPose:
    """The pose without rigid motion: expression, jaw, eyes and eyelids alone."""
    return replace(pose, rotation=np.zeros(3), neck=np.zeros(3), translation=np.zeros(3))
