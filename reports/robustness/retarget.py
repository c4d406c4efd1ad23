"""Another subject's motion carried over to a target: expression as it is, rigid motion about the target's own mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...bench.contracts import FloatArray, HeadAsset, HeadPose
from ...bench.errors import InputError


@dataclass(frozen=True, eq=False)
class RigidMean:
    """Where a subject's head rests: mean rotation and neck rotation, (3, 3) each, and mean translation, metres."""

    rotation: FloatArray
    neck: FloatArray
    translation: FloatArray

    @classmethod
    def of(cls, poses: Sequence[HeadPose]) -> RigidMean:
        """Mean over poses; rotations by the chordal mean, the rotation nearest to all in the Frobenius norm."""
        return cls(
            _mean_rotation([_matrix(pose.rotation) for pose in poses]),
            _mean_rotation([_matrix(pose.neck) for pose in poses]),
            np.mean([np.asarray(pose.translation, np.float64) for pose in poses], axis=0),
        )


def retarget(pose: HeadPose, source: RigidMean, target: RigidMean, subject: str) -> HeadPose:
    """Carry a pose of the source over to the target.

    The head turns and moves, seen from its own mean pose, as the source's does from its own, so that the axes of
    the two captures need not agree. Expression, jaw, eyes and eyelids are kept. The pose belongs to no timestep.
    """
    rotation = target.rotation @ source.rotation.T @ _matrix(pose.rotation)
    neck = target.neck @ source.neck.T @ _matrix(pose.neck)
    moved = target.rotation @ source.rotation.T @ (pose.translation - source.translation)
    return replace(
        pose,
        rotation=_axis_angle(rotation).astype(pose.rotation.dtype),
        neck=_axis_angle(neck).astype(pose.neck.dtype),
        translation=(target.translation + moved).astype(pose.translation.dtype),
        subject=subject,
        timestep=None,
    )


def check_heads(source: HeadAsset, target: HeadAsset, where: str) -> None:
    """Raise `InputError` where the source's coefficients mean nothing to the target's head model."""
    ours, theirs = (f"{h.version}, {h.expression_basis.shape[2]} expressions" for h in (target, source))
    if ours != theirs:
        remedy = "Carry the source over to the target's head model first: headbench refit."
        raise InputError(where, "head model", ours, theirs, remedy)


def _matrix(axis_angle: FloatArray) -> FloatArray:
    return np.asarray(cv2.Rodrigues(np.asarray(axis_angle, np.float64))[0])


def _axis_angle(rotation: FloatArray) -> FloatArray:
    return np.asarray(cv2.Rodrigues(rotation)[0][:, 0])


def _mean_rotation(rotations: Sequence[FloatArray]) -> FloatArray:
    left, _, right = np.linalg.svd(np.sum(rotations, axis=0))
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)
