"""The head's rigid motion, moved from the head into the camera: what methods for a single video work with.

A tracker of single videos keeps the head still and lets the camera move around it. With M the rigid motion of the
head (global rotation about the root joint, neck rotation about the neck joint, translation) a camera W in the
world becomes W M in the head's frame, and the pose keeps expression, jaw, eyes and eyelids alone. Projections of
vertices that move with the neck joint stay the same, but for the neck's pose correctives; vertices that hang on the
root (lower neck, shoulders) are carried along with the head, which is what such methods do with them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from ...bench.contracts import Camera, FloatArray, HeadAsset, HeadPose
from .model import HeadModel

BATCH = 64
"""Poses evaluated at once, which bounds the memory of long sequences."""


def rigid_motions(
    head: HeadAsset, shape: FloatArray, static_offset: FloatArray, poses: Sequence[HeadPose]
) -> FloatArray:
    """(T, 4, 4) float64 rigid motion of the head in each pose: head frame to world, metres.

    Raises `InputError` for poses of another head model.
    """
    model = HeadModel(head, dtype=torch.float64)
    identity = {
        "shape": torch.from_numpy(np.asarray(shape, np.float64)),
        "static_offset": torch.from_numpy(np.asarray(static_offset, np.float64)),
    }
    parts = []
    for chunk in _chunks(poses):
        arguments = model.pose_arguments(chunk)
        moving = {name: arguments[name] for name in ("expression", "rotation", "neck", "translation")}
        parts.append(model.head_transform(**identity, **moving).numpy())
    return np.concatenate(parts)


def camera_in_head_frame(camera: Camera, motion: FloatArray) -> Camera:
    """The camera as it stands to a head that does not move; ``motion`` is the (4, 4) rigid motion of the pose."""
    return replace(camera, world_to_camera=np.asarray(camera.world_to_camera, np.float64) @ motion)


def pose_in_head_frame(pose: HeadPose) -> HeadPose:
    """The pose without rigid motion."""
    still = np.zeros(3)
    return replace(pose, rotation=still, neck=still, translation=still)


def _chunks(poses: Sequence[HeadPose]) -> Iterator[Sequence[HeadPose]]:
    for start in range(0, len(poses), BATCH):
        yield poses[start : start + BATCH]
