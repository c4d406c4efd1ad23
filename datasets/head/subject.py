"""A head with one identity: its neutral mesh, and its meshes and rigid motions over poses.

A tracker of single videos keeps the head still and lets the camera move around it. With M the rigid motion of the
head (global rotation about the root joint, neck rotation about the neck joint, translation) a camera W in the
world becomes W M in the head's frame, and the pose keeps only expression, jaw, eyes and eyelids. Projections of
vertices that follow the neck joint are unchanged except for the neck's pose correctives; vertices that follow the root
(lower neck, shoulders) move with the head, as in such methods.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
import torch

from ...bench.contracts import Camera, Clip, FloatArray, HeadAsset, HeadPose
from .model import HeadModel

BATCH = 64
"""Number of poses evaluated at once, to limit memory for long sequences."""


class PosedSubject:
    """One identity of a head model.

    Parameters
    ----------
    shape : FloatArray
        (S,) identity coefficients.
    static_offset : FloatArray
        (V, 3) metres.
    """

    def __init__(
        self,
        head: HeadAsset,
        shape: FloatArray,
        static_offset: FloatArray,
        dtype: torch.dtype = torch.float64,
    ):
        self._model = HeadModel(head, dtype=dtype)
        identity = {"shape": shape, "static_offset": static_offset}
        self._identity = {
            name: torch.tensor(np.asarray(values), dtype=dtype) for name, values in identity.items()
        }
        self._canonical = self._model.canonical(**self._identity)
        self.version = head.version
        self.neutral: FloatArray = self._canonical[0].numpy()
        """(V, 3) unposed head, metres."""

    @classmethod
    def of(cls, clip: Clip, dtype: torch.dtype = torch.float64) -> PosedSubject:
        """The subject of a clip."""
        return cls(clip.head, clip.shape, clip.static_offset, dtype)

    def meshes(self, poses: Sequence[HeadPose]) -> FloatArray:
        """(T, V, 3) vertices in the world, metres. Raises `InputError` for poses of another model."""
        return np.concatenate([*self.batches(poses)])

    def batches(self, poses: Sequence[HeadPose], size: int = BATCH) -> Iterator[FloatArray]:
        """`meshes` of up to ``size`` poses at a time."""
        for arguments in self._arguments(poses, size):
            with torch.no_grad():
                yield self._model(canonical=self._canonical, **arguments).numpy()

    def each(
        self, clip: Clip, timesteps: Sequence[int], size: int = BATCH
    ) -> Iterator[tuple[int, FloatArray]]:
        """Yield (timestep, (V, 3) mesh) for a clip's poses, computed in batches of ``size``."""
        poses = [clip.poses[timestep] for timestep in timesteps]
        return zip(timesteps, chain.from_iterable(self.batches(poses, size)))

    def motions(self, poses: Sequence[HeadPose]) -> FloatArray:
        """(T, 4, 4) rigid motion of the head, from the frame with the neck joint at rest to the world, metres.

        Raises `InputError` for poses of another model.
        """

        moving = ("expression", "rotation", "neck", "translation")
        return np.concatenate(
            [
                self._model.head_transform(
                    **self._identity, **{name: arguments[name] for name in moving}
                ).numpy()
                for arguments in self._arguments(poses, BATCH)
            ]
        )

    def translations(self, poses: Sequence[HeadPose], motions: FloatArray) -> FloatArray:
        """(T, 3) translations, metres, with which poses without translation reproduce (T, 4, 4) ``motions``."""
        return np.asarray(motions[:, :3, 3] - self.motions(poses)[:, :3, 3])

    def _arguments(self, poses: Sequence[HeadPose], size: int) -> Iterator[dict[str, torch.Tensor]]:
        for start in range(0, max(len(poses), 1), size):  # without poses the model raises an error
            yield self._model.pose_arguments(poses[start : start + size])


def camera_in_head_frame(camera: Camera, motion: FloatArray) -> Camera:
    """The camera relative to a head that does not move; ``motion`` is the (4, 4) rigid motion of the pose."""
    return replace(camera, world_to_camera=np.asarray(camera.world_to_camera, np.float64) @ motion)


def pose_in_head_frame(pose: HeadPose) -> HeadPose:
    """The pose without rigid motion."""
    rest = np.zeros(3)
    return replace(pose, rotation=rest, neck=rest, translation=rest)


def resting(head: HeadAsset, subject: str = "") -> HeadPose:
    """The neutral pose of a head model, at the origin."""
    expression, none = np.zeros(head.expression_basis.shape[2]), np.zeros(3)
    lids = None if head.eyelid_basis is None else np.zeros(head.eyelid_basis.shape[2])
    return HeadPose(head.version, expression, none, none, none, np.zeros(6), none, lids, subject)
