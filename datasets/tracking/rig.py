"""Points on a head model and their derivatives by all parameters, for Gauss-Newton steps.

A point is a fixed mixture of up to three vertices. Bases and skinning weights are mixed once, so that a few thousand points
are evaluated instead of the whole mesh. At vertices this is exact; inside a triangle it differs from mixing the posed vertices
by a part of the change of the skinning weights across the triangle.

Timesteps whose fit differs from that of their neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from ...bench.contracts import BoolArray, FloatArray, HeadAsset, HeadPose, IntArray
from ..head.arrays import JOINT_NAMES
from ..head.rotations import matrices_and_derivatives, rotation_of

JOINTS = len(JOINT_NAMES)
ANGLES = 3 * JOINTS


class PoseColumns(NamedTuple):
    """Order of the numbers of a timestep: angles of all joints, translation, expression, eyelids."""

    expression_size: int
    eyelid_size: int

    @classmethod
    def of(cls, head: HeadAsset) -> PoseColumns:
        """The columns of a head model."""
        lids = 0 if head.eyelid_basis is None else head.eyelid_basis.shape[2]
        return cls(head.expression_basis.shape[2], lids)

    @property
    def size(self) -> int:
        """D, the number of columns."""
        return ANGLES + 3 + self.expression_size + self.eyelid_size

    @property
    def translation(self) -> slice:
        """Columns of the translation, metres."""
        return slice(ANGLES, ANGLES + 3)

    def rows(self, poses: Sequence[HeadPose]) -> FloatArray:
        """Poses as rows (T, D)."""
        names = ("rotation", "neck", "jaw", "eyes", "translation", "expression", "eyelids")
        used = names if self.eyelid_size else names[:-1]
        return np.stack([np.concatenate([getattr(pose, name) for name in used]) for pose in poses])

    def poses(
        self, values: FloatArray, head: HeadAsset, subject: str, timesteps: Sequence[int]
    ) -> list[HeadPose]:
        """Rows (T, D) as poses, rounded to float32 as they are stored."""
        result = []
        for timestep, row in zip(timesteps, np.asarray(values, np.float32).astype(np.float64), strict=True):
            angles = row[:ANGLES].reshape(JOINTS, 3)
            lids = row[self.size - self.eyelid_size :]
            fields: dict[str, Any] = {
                "rotation": angles[0],
                "neck": angles[1],
                "jaw": angles[2],
                "eyes": angles[3:].ravel(),
            }
            fields |= {"translation": row[self.translation], "eyelids": lids if self.eyelid_size else None}
            expression = row[ANGLES + 3 : ANGLES + 3 + self.expression_size]
            result.append(HeadPose(head.version, expression, **fields, subject=subject, timestep=timestep))
        return result


class PosedPoints(NamedTuple):
    """Points of one timestep and their derivatives."""

    points: FloatArray
    """(P, 3) in the world, metres."""
    by_pose: FloatArray
    """(P, 3, D) derivatives by the columns of `PoseColumns`."""
    by_shape: FloatArray
    """(P, 3, S) derivatives by the identity coefficients."""


@dataclass(frozen=True, eq=False)
class _Joints:
    """Motions ``R x + o`` of all joints and their derivatives."""

    turns: FloatArray  # (J, 3, 3)
    shifts: FloatArray  # (J, 3)
    turns_by_angle: FloatArray  # (3 J, J, 3, 3)
    shifts_by_angle: FloatArray  # (3 J, J, 3)
    shifts_by_coefficient: FloatArray  # (J, 3, E + S)


class _Posed(NamedTuple):
    points: FloatArray
    unposed: FloatArray  # (P, 3)
    turns: FloatArray  # (P, 3, 3) mixed rotations
    joints: _Joints
    derivatives: FloatArray  # (J, 3, 3, 3) of the local rotations


class PointRig:
    """P points on a head model. ``head``: Head model in FLAME's layout. ``corners``: (P, 3) vertices of each point.
    ``weights``: (P, 3) their shares, rows sum to 1. ``dtype``: Type of the points and of the derivatives."""

    def __init__(self, head: HeadAsset, corners: IntArray, weights: FloatArray, dtype: Any = np.float32):
        def mixed(values: Any) -> FloatArray:
            array = np.asarray(values, np.float64)
            return np.einsum("pk,pk...->p...", weights, array[corners])

        self.columns = PoseColumns.of(head)
        self.shape_size = head.shape_basis.shape[2]
        self._dtype = dtype
        self._parents = [int(parent) for parent in head.parents]
        self._template = mixed(head.template)
        # Expression, then shape: both move the unposed points and the joints linearly.
        basis = np.concatenate([mixed(head.expression_basis), mixed(head.shape_basis)], axis=2)
        self._basis = basis.astype(dtype)
        self._correctives = mixed(head.pose_basis).astype(dtype)
        self._skin = mixed(head.skinning_weights).astype(dtype)
        self._lids = None if head.eyelid_basis is None else mixed(head.eyelid_basis).astype(dtype)
        regressor = np.asarray(head.joint_regressor, np.float64)
        self._rest = regressor @ head.template
        bases = np.concatenate([head.expression_basis, head.shape_basis], axis=2)
        self._joint_basis = np.tensordot(regressor, np.asarray(bases, np.float64), 1)

    @classmethod
    def at_vertices(cls, head: HeadAsset, vertices: IntArray, dtype: Any = np.float32) -> PointRig:
        """The points are vertices."""
        weights = np.tile([1.0, 0.0, 0.0], (len(vertices), 1))
        return cls(head, np.repeat(vertices[:, None], 3, axis=1), weights, dtype)

    def points(self, shape: FloatArray, pose: FloatArray) -> FloatArray:
        """(P, 3) points in the world, metres, of shape (S,) and pose (D,)."""
        return self._posed(shape, pose).points

    def linearised(self, shape: FloatArray, pose: FloatArray) -> PosedPoints:
        """Points and their derivatives for shape (S,) and pose (D,)."""
        columns, expressions = self.columns, self.columns.expression_size
        points, unposed, turns, joints, derivatives = self._posed(shape, pose)
        count = len(points)

        linear = turns @ self._basis
        by_coefficient = joints.shifts_by_coefficient.reshape(JOINTS, -1).astype(self._dtype)
        linear += (self._skin @ by_coefficient).reshape(linear.shape)
        by_pose = np.zeros((count, 3, columns.size), self._dtype)
        by_pose[:, 0, ANGLES] = by_pose[:, 1, ANGLES + 1] = by_pose[:, 2, ANGLES + 2] = 1
        by_pose[:, :, ANGLES + 3 : ANGLES + 3 + expressions] = linear[:, :, :expressions]
        # Skinning: sum_j w_j (dR_j x + do_j), with x extended by 1 so that both are one product.
        extended = np.concatenate([unposed, np.ones((count, 1), self._dtype)], axis=1)
        weighted = (self._skin[:, :, None] * extended[:, None]).reshape(count, -1)  # (P, 4 J)
        motion = np.concatenate(
            [joints.turns_by_angle, joints.shifts_by_angle[..., None]], axis=3
        )  # (3 J, J, 3, 4)
        motion = motion.transpose(1, 3, 2, 0).reshape(4 * JOINTS, -1).astype(self._dtype)
        by_pose[:, :, :ANGLES] = (weighted @ motion).reshape(count, 3, ANGLES)
        entries = derivatives[1:].reshape(JOINTS - 1, 9, 3).astype(self._dtype)
        for joint in range(1, JOINTS):
            bent = self._correctives[:, :, 9 * joint - 9 : 9 * joint] @ entries[joint - 1]
            by_pose[:, :, 3 * joint : 3 * joint + 3] += turns @ bent
        if self._lids is not None:
            closed = self._lids @ pose[columns.size - columns.eyelid_size :].astype(self._dtype)
            by_pose[:, :, columns.size - columns.eyelid_size :] = (
                joints.turns[1].astype(self._dtype) @ self._lids
            )
            turned = joints.turns_by_angle[:6, 1].astype(self._dtype)  # by root and neck
            by_pose[:, :, :6] += np.einsum("kij,pj->pik", turned, closed)
        return PosedPoints(points, by_pose, linear[:, :, expressions:])

    def _posed(self, shape: FloatArray, pose: FloatArray) -> _Posed:
        start, kind = ANGLES + 3, self._dtype
        coefficients = np.concatenate([pose[start : start + self.columns.expression_size], shape])
        joints, rotations, derivatives = self._motions(coefficients, pose)
        feature = (rotations[1:] - np.eye(3)).ravel().astype(kind)
        blend = self._basis @ coefficients.astype(kind) + self._correctives @ feature
        unposed = self._template.astype(kind) + blend
        turns = (self._skin @ joints.turns.reshape(JOINTS, 9).astype(kind)).reshape(-1, 3, 3)
        shifts = self._skin @ joints.shifts.astype(kind) + pose[self.columns.translation].astype(kind)
        points = (turns @ unposed[..., None])[..., 0] + shifts
        if self._lids is not None:
            closed = self._lids @ pose[self.columns.size - self.columns.eyelid_size :].astype(kind)
            points = points + closed @ joints.turns[1].T.astype(kind)
        return _Posed(points, unposed, turns, joints, derivatives)

    def _motions(self, coefficients: FloatArray, pose: FloatArray) -> tuple[_Joints, FloatArray, FloatArray]:
        """Motions of the joints, their local rotations (J, 3, 3) and the derivatives of these (J, 3, 3, 3)."""
        rotations, derivatives = matrices_and_derivatives(
            np.asarray(pose[:ANGLES], np.float64).reshape(JOINTS, 3)
        )
        rest = self._rest + self._joint_basis @ coefficients
        turns, shifts = np.zeros((JOINTS, 3, 3)), np.zeros((JOINTS, 3))
        turns_by, shifts_by = np.zeros((ANGLES, JOINTS, 3, 3)), np.zeros((ANGLES, JOINTS, 3))
        by_coefficient = np.zeros(self._joint_basis.shape)
        for joint, parent in enumerate(self._parents):
            above, shift = (np.eye(3), np.zeros(3)) if parent < 0 else (turns[parent], shifts[parent])
            turns[joint] = above @ rotations[joint]
            columns = slice(3 * joint, 3 * joint + 3)
            turns_by[columns, joint] = above @ derivatives[joint].transpose(2, 0, 1)
            bend_by = -turns_by[:, joint]
            by_coefficient[joint] = (above - turns[joint]) @ self._joint_basis[joint]
            if parent >= 0:
                turns_by[:, joint] += turns_by[:, parent] @ rotations[joint]
                bend_by = turns_by[:, parent] - turns_by[:, joint]
                shifts_by[:, joint] = shifts_by[:, parent]
                by_coefficient[joint] += by_coefficient[parent]
            shifts[joint] = shift + (above - turns[joint]) @ rest[joint]
            shifts_by[:, joint] += bend_by @ rest[joint]
        return _Joints(turns, shifts, turns_by, shifts_by, by_coefficient), rotations, derivatives


WINDOW = 9
"""Timesteps with whose median one in their middle is compared."""
TURN, MOVE = 0.25, 0.08
"""Minimum rotation of the head, radians, and translation, metres, from the median that count as a jump."""
USUAL = 6.0
"""Minimum ratio of a jump to the median difference, for captures with few timesteps or fast motion."""
WORSE = 2.5
"""Minimum ratio of a residual to its median that counts as a fit that failed."""


def outliers(poses: FloatArray, residuals: FloatArray, columns: PoseColumns) -> BoolArray:
    """(T,) timesteps without a fit to landmarks, with a jump of the head, or with a much larger residual than their neighbours.

    ``poses``: (T, D) columns of ``columns``. ``residuals``: (T, 2) `TimestepResidual` without the timestep; 0 pixels where
    no landmark was used.
    """
    turns = (rotation_of(poses[:, :3]) * rotation_of(poses[:, 3:6])).as_matrix().reshape(-1, 9)
    wrong = (residuals[:, 0] <= 0) | (residuals > WORSE * _median(residuals)).any(axis=1)
    # The Frobenius norm of the difference of two rotations is about their angle times the root of 2.
    for values, least in ((turns / np.sqrt(2), TURN), (poses[:, columns.translation], MOVE)):
        distances = np.linalg.norm(values - _median(values), axis=1)
        wrong |= distances > max(least, USUAL * float(np.median(distances)))
    return np.asarray(wrong)


def _median(values: FloatArray) -> FloatArray:
    return np.asarray(ndimage.median_filter(values, (WINDOW, 1), mode="nearest"))
