"""Rotation of the neck moved into the rigid motion of the head, as trackers without a neck joint describe a head."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.contracts import Clip, FloatArray, HeadPose
from ...bench.engine.config import RunConfig
from ..clip import CaptureClip, as_capture
from ..head.subject import PosedSubject


def as_rigid_head(clip: Clip, config: RunConfig) -> CaptureClip:
    """A clip whose poses have no rotation of the neck: root and translation make up the motion of the head.

    Vertices that fully follow the neck do not move; those below it follow the head. Images are unchanged.
    """
    source = as_capture(clip)
    subject = PosedSubject.of(source)
    poses = list(source.poses.values())
    motions = subject.motions(poses)
    turned = [_turned(pose, motion) for pose, motion in zip(poses, motions)]
    translations = subject.translations(turned, motions).astype(np.float32)
    moved = [replace(pose, translation=each) for pose, each in zip(turned, translations)]
    return source.derive("as_rigid_head", {}, poses=dict(zip(source.poses, moved)))


def _turned(pose: HeadPose, motion: FloatArray) -> HeadPose:
    """The pose with the rotation of a (4, 4) motion of the head, without neck and translation."""
    rotation = Rotation.from_matrix(np.asarray(motion)[:3, :3]).as_rotvec().astype(np.float32)
    zero = np.zeros(3, np.float32)
    return replace(pose, rotation=rotation, neck=zero, translation=zero)
