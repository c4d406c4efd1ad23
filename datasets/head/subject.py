"""A head with one identity: its neutral mesh, and its meshes and rigid motions over poses, in float64.

A tracker of single videos keeps the head still and lets the camera move around it. With M the rigid motion of the
head (global rotation about the root joint, neck rotation about the neck joint, translation) a camera W in the
world becomes W M in the head's frame, and the pose keeps expression, jaw, eyes and eyelids alone. Projections of
vertices that move with the neck joint stay the same, but for the neck's pose correctives; vertices that hang on the
root (lower neck, shoulders) move with the head, as they do in such methods.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Camera, FloatArray, HeadAsset, HeadPose
from .model import HeadModel

BATCH = 64
"""Poses evaluated at once, which bounds the memory of long sequences."""


class PosedSubject:
    """One identity of a head model, float64.

    Parameters
    ----------
    head : the model.
    shape : (S,) identity coefficients.
    static_offset : (V, 3) metres.
    """

    def __init__(self, head: HeadAsset, shape: FloatArray, static_offset: FloatArray):
        self._model = HeadModel(head, dtype=torch.float64)
        shape, offset = np.asarray(shape, dtype=np.float64), np.asarray(static_offset, dtype=np.float64)
        self._identity = {"shape": torch.from_numpy(shape), "static_offset": torch.from_numpy(offset)}
        self._canonical = self._model.canonical(**self._identity)

    @property
    def version(self) -> str:
        """Of the head model."""
        return self._model.version

    @property
    def neutral(self) -> FloatArray:
        """(V, 3) unposed head, metres."""
        return np.asarray(self._canonical[0].numpy())

    def meshes(self, poses: Sequence[HeadPose]) -> FloatArray:
        """(T, V, 3) vertices in the world, metres. Raises `InputError` for poses of another model."""
        return self._batched(poses, lambda arguments: self._model(canonical=self._canonical, **arguments))

    def motions(self, poses: Sequence[HeadPose]) -> FloatArray:
        """(T, 4, 4) rigid motion of the head, from the frame with the neck joint at rest to the world, metres.

        Raises `InputError` for poses of another model.
        """

        def motion(arguments: dict[str, Tensor]) -> Tensor:
            moving = {name: arguments[name] for name in ("expression", "rotation", "neck", "translation")}
            return self._model.head_transform(**self._identity, **moving)

        return self._batched(poses, motion)

    def _batched(
        self, poses: Sequence[HeadPose], evaluate: Callable[[dict[str, Tensor]], Tensor]
    ) -> FloatArray:
        batches = [poses[start : start + BATCH] for start in range(0, len(poses), BATCH)] or [poses]
        with torch.no_grad():
            return np.concatenate([evaluate(self._model.pose_arguments(batch)).numpy() for batch in batches])


def camera_in_head_frame(camera: Camera, motion: FloatArray) -> Camera:
    """The camera relative to a head that does not move; ``motion`` is the (4, 4) rigid motion of the pose."""
    return replace(camera, world_to_camera=np.asarray(camera.world_to_camera, np.float64) @ motion)


def pose_in_head_frame(pose: HeadPose) -> HeadPose:
    """The pose without rigid motion."""
    rest = np.zeros(3)
    return replace(pose, rotation=rest, neck=rest, translation=rest)
