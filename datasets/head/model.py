"""The differentiable head: linear blendshapes, pose correctives and skinning over any head in FLAME's layout.

Li et al., "Learning a model of facial shape and expression from 4D scans", SIGGRAPH Asia 2017, section 4;
the formulation of the skinning is that of SMPL (Loper et al., SIGGRAPH Asia 2015, section 3).

A head with one identity: its neutral mesh, and its meshes and rigid motions over poses. A tracker of single videos
keeps the head still and lets the camera move around it. With M the rigid motion of the head (global rotation about the
root joint, neck rotation about the neck joint, translation) a camera W in the world becomes W M in the head's frame,
and the pose keeps only expression, jaw, eyes and eyelids. Projections of vertices that follow the neck joint are
unchanged except for the neck's pose correctives; vertices that follow the root (lower neck, shoulders) move with the
head, as in such methods.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Camera, Clip, FloatArray, FrameKey, HeadAsset, HeadPose
from ...bench.errors import InputError
from ...bench.native.dispatch import to_device
from .rotations import axis_angle_to_matrix, rotation_of


class HeadModel(torch.nn.Module):
    """Vertices of a head from identity, expression and pose. Batched and differentiable in every input.

    Every argument is ``(B, n)`` or ``(n,)``, and arguments of batch size 1 are broadcast. Lengths are metres,
    rotations axis-angle in radians.

    ``asset``: Head in FLAME's layout, e.g. `HeadArrays`. ``dtype``, ``device``: Type and device of the buffers; inputs must
    match.
    """

    template: Tensor
    faces: Tensor
    shape_matrix: Tensor
    blend_matrix: Tensor
    joint_regressor: Tensor
    joint_matrix: Tensor
    skinning_weights: Tensor
    eyelid_matrix: Tensor | None

    def __init__(
        self, asset: HeadAsset, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__()
        self.version = asset.version
        self.parents = tuple(int(parent) for parent in asset.parents)

        def buffer(name: str, values: Any) -> None:
            array = np.ascontiguousarray(values, dtype=np.float64)
            # A copy: the arrays of a head model are read-only and shared by all methods.
            self.register_buffer(name, torch.tensor(array, device=device, dtype=dtype), persistent=False)

        def basis(name: str, values: Any) -> None:
            # (V, 3, K) to (K, 3V), so that the product with coefficients is one matrix multiplication.
            buffer(name, np.asarray(values).reshape(3 * len(values), -1).T)  # K may be 0

        buffer("template", asset.template)
        basis("shape_matrix", asset.shape_basis)
        basis("blend_matrix", np.concatenate([asset.expression_basis, asset.pose_basis], axis=2))
        buffer("joint_regressor", asset.joint_regressor)
        buffer("skinning_weights", asset.skinning_weights)
        if asset.eyelid_basis is None:
            self.eyelid_matrix = None
        else:
            basis("eyelid_matrix", asset.eyelid_basis)
        self.expression_size = np.shape(asset.expression_basis)[2]
        """E, the number of expression coefficients."""
        regressor = np.asarray(asset.joint_regressor, np.float64)
        self._joint_basis: FloatArray = np.tensordot(
            regressor, np.asarray(asset.expression_basis, np.float64), 1
        )
        basis("joint_matrix", self._joint_basis)
        faces = torch.tensor(np.asarray(asset.faces, dtype=np.int64), device=device)
        self.register_buffer("faces", faces, persistent=False)

    @property
    def shape_size(self) -> int:
        """S, the number of identity coefficients."""
        return self.shape_matrix.shape[0]

    @property
    def expression_matrix(self) -> Tensor:
        """(E, 3 V) expression basis."""
        return self.blend_matrix[: self.expression_size]

    @property
    def pose_matrix(self) -> Tensor:
        """(9 (J - 1), 3 V) basis of the pose correctives."""
        return self.blend_matrix[self.expression_size :]

    def forward(
        self,
        *,
        shape: Tensor | None = None,
        expression: Tensor,
        rotation: Tensor,
        neck: Tensor,
        jaw: Tensor,
        eyes: Tensor,
        translation: Tensor,
        static_offset: Tensor | None = None,
        eyelids: Tensor | None = None,
        canonical: Tensor | None = None,
    ) -> Tensor:
        """Vertices (B, V, 3), metres.

        Shaped mesh, joints regressed from it, pose correctives, linear blend skinning, translation, eyelids.

        Parameters
        ----------
        shape : Tensor | None
            (B, S) identity coefficients.
        expression : Tensor
            (B, E).
        rotation, neck, jaw : Tensor
            (B, 3); ``rotation`` is about joint 0, not about the origin.
        eyes : Tensor
            (B, 6) left, then right.
        translation : Tensor
            (B, 3).
        static_offset : Tensor | None
            (B, V, 3) or (V, 3), added to the shaped template.
        eyelids : Tensor | None
            (B, 2) left, right; only for models with eyelid bases. Added after skinning and rotated with root and neck,
            so that lids move rigidly with the head; trackers with eyelids keep both at rest.
        canonical : Tensor | None
            (B, V, 3) output of `canonical` for this identity; replaces ``shape`` and
            ``static_offset``. Saves time if the identity is fixed, because the identity basis is
            the largest array.
        """
        neutral = self._neutral(shape, static_offset, canonical)
        expression = _rows(expression)
        angles = self.angles(rotation, neck, jaw, eyes)
        rotations = axis_angle_to_matrix(angles)
        shaped = neutral + (expression @ self.expression_matrix).unflatten(1, (-1, 3))
        posed = shaped + (pose_feature(rotations) @ self.pose_matrix).unflatten(1, (-1, 3))
        motions = joint_motions(rotations, self.rest_joints(neutral, expression), self.parents)
        blended = (self.skinning_weights @ motions.flatten(2)).unflatten(2, (3, 4))
        moved = (blended[..., :3] @ posed[..., None])[..., 0] + blended[..., 3]
        vertices = moved + _rows(translation)[:, None]
        if eyelids is not None:
            assert self.eyelid_matrix is not None
            lids = (_rows(eyelids) @ self.eyelid_matrix).unflatten(1, (-1, 3))
            vertices = vertices + lids @ (rotations[:, 0] @ rotations[:, 1]).mT
        return vertices

    @torch.no_grad()
    def driven(self, neutral: Tensor, joints: FloatArray, pose: HeadPose) -> Tensor:
        """Vertices of one pose as `forward` gives them, (V, 3), metres, without gradients.

        Joints are moved on the host in float64: their many small operations take most of the time of `forward`, above all on a GPU.

        ``neutral``: (V, 3) result of `canonical`. ``joints``: (J, 3) its rest positions.
        """
        columns = {name: values[0] for name, values in self.pose_columns([pose]).items()}
        angles = np.concatenate([columns[name] for name in ("rotation", "neck", "jaw", "eyes")]).reshape(
            -1, 3
        )
        rotations = torch.from_numpy(rotation_of(angles).as_matrix())[None]
        rest = torch.from_numpy(joints + self._joint_basis @ columns["expression"])[None]
        motions = joint_motions(rotations, rest, self.parents)
        values = [torch.from_numpy(columns["expression"]), pose_feature(rotations)[0], motions.flatten()]
        values += [torch.from_numpy(columns[name]) for name in ("translation", "eyelids") if name in columns]
        packed = to_device(
            torch.cat([*values, motions[0, 1, :, :3].T.flatten()]).to(neutral.dtype), neutral.device
        )
        sizes = [len(self.blend_matrix), motions.numel(), 3, *[2] * (self.eyelid_matrix is not None), 9]
        blend, motion, translation, *lids, turn = packed.split(sizes)
        shaped = torch.addmm(neutral.view(1, -1), blend[None], self.blend_matrix).view(-1, 3, 1)
        blended = (self.skinning_weights @ motion.view(len(joints), 12)).view(-1, 3, 4)
        vertices = torch.baddbmm(blended[:, :, 3:], blended[:, :, :3], shaped)[:, :, 0] + translation
        if self.eyelid_matrix is not None:
            vertices = vertices + (lids[0] @ self.eyelid_matrix).view(-1, 3) @ turn.view(3, 3)
        return vertices

    def canonical(self, shape: Tensor, static_offset: Tensor | None = None) -> Tensor:
        """Neutral, unposed head of an identity: (B, V, 3), metres."""
        blend = _rows(shape) @ self.shape_matrix
        vertices = self.template + blend.unflatten(1, (-1, 3))
        return vertices if static_offset is None else vertices + static_offset

    def joints(self, shape: Tensor, expression: Tensor, static_offset: Tensor | None = None) -> Tensor:
        """Joint positions of the shaped, unposed head: (B, J, 3), metres."""
        expression = _rows(expression)
        return self.rest_joints(self.canonical(shape, static_offset), expression)

    def rest_joints(self, neutral: Tensor, expression: Tensor) -> Tensor:
        """Joint positions (B, J, 3), metres, of a neutral head (B, V, 3) with expression coefficients (B, E)."""
        return self.joint_regressor @ neutral + (expression @ self.joint_matrix).unflatten(1, (-1, 3))

    def head_transform(
        self,
        *,
        shape: Tensor,
        expression: Tensor,
        rotation: Tensor,
        neck: Tensor,
        translation: Tensor,
        static_offset: Tensor | None = None,
    ) -> Tensor:
        """Rigid motion of the head, (B, 4, 4): translation after the root's and the neck's rotation. This is the head
        pose of trackers: it moves vertices that follow only the neck joint, apart from the neck's pose correctives."""
        joints = self.joints(shape, expression, static_offset)
        still = torch.zeros_like(_rows(rotation))
        angles = self.angles(rotation, neck, still, torch.cat([still, still], dim=-1))
        rotations = axis_angle_to_matrix(angles)
        motion = joint_motions(rotations, joints, self.parents)[:, 1]
        turn, shift = motion[..., :3], motion[..., 3] + _rows(translation)
        batch = shift.shape[0]
        last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=turn.dtype, device=turn.device).expand(batch, 1, 4)
        return torch.cat([torch.cat([turn.expand(batch, 3, 3), shift[..., None]], dim=-1), last], dim=-2)

    def pose_arguments(self, poses: Sequence[HeadPose]) -> dict[str, Tensor]:
        """Poses as arguments of `forward`, with this model's dtype and device. ``eyelids`` is included only if the
        model has eyelid bases (zeros for poses without them)."""
        columns = self.pose_columns(poses)
        # One array, so that one copy takes it to a device.
        joined = torch.from_numpy(np.concatenate([*columns.values()], axis=1)).to(self.template.dtype)
        parts = to_device(joined, self.template.device).split([part.shape[1] for part in columns.values()], 1)
        return {name: part.clone() for name, part in zip(columns, parts)}

    def pose_columns(self, poses: Sequence[HeadPose]) -> dict[str, FloatArray]:
        """Result of `pose_arguments` as float64 arrays on the host: (T, n) each."""
        sizes = {"expression": self.expression_size, "rotation": 3, "neck": 3, "jaw": 3, "eyes": 6}
        sizes["translation"] = 3
        for pose in poses:
            self._check_pose(pose, sizes)
        columns = {name: np.stack([getattr(pose, name) for pose in poses]) for name in sizes}
        if self.eyelid_matrix is not None:
            lids = [np.zeros(2) if pose.eyelids is None else pose.eyelids for pose in poses]
            columns["eyelids"] = np.stack(lids)
        return {name: np.asarray(values, np.float64) for name, values in columns.items()}

    def _check_pose(self, pose: HeadPose, sizes: dict[str, int]) -> None:
        where = f"pose of {pose.subject or 'unnamed subject'}"
        if pose.timestep is not None:
            where += f", timestep {pose.timestep}"
        if pose.head_model != self.version:
            remedy = (
                "Coefficients of different head models are not interchangeable; refit the tracking first."
            )
            raise InputError(where, "head_model", repr(self.version), repr(pose.head_model), remedy)
        for name, size in sizes.items():
            found = np.shape(getattr(pose, name))
            if found != (size,):
                raise InputError(where, name, f"shape ({size},)", f"shape {found}")

    def _neutral(
        self, shape: Tensor | None, static_offset: Tensor | None, canonical: Tensor | None
    ) -> Tensor:
        """(B, V, 3) neutral head, given directly or by identity."""
        if canonical is not None:
            return canonical
        assert shape is not None
        return self.canonical(shape, static_offset)

    def angles(self, rotation: Tensor, neck: Tensor, jaw: Tensor, eyes: Tensor) -> Tensor:
        """Axis-angle vectors in joint order, (B, J, 3)."""
        parts = [_rows(part) for part in (rotation, neck, jaw, eyes)]
        batch = max(part.shape[0] for part in parts)
        return torch.cat([part.expand(batch, -1) for part in parts], dim=1).unflatten(1, (-1, 3))


def pose_feature(rotations: Tensor) -> Tensor:
    """(B, 9 (J - 1)) coefficients of the pose correctives: the entries of R - I of every joint but the root."""
    identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
    return (rotations[:, 1:] - identity).flatten(1)


def joint_motions(rotations: Tensor, joints: Tensor, parents: Sequence[int]) -> Tensor:
    """Rigid motions of points that follow the joints: a point x is moved to ``R x + o``.

    With local rotation Q_j and parent p: R_j = R_p Q_j and o_j = o_p + (R_p - R_j) c_j for a joint with rest position
    c_j.

    ``rotations``: (B, J, 3, 3) local rotation of each joint relative to its parent. ``joints``: (B, J, 3) rest positions;
    the root does not move. ``parents``: Parent of each joint, -1 for the root; parents come first.

    Returns
    -------
    Tensor
        (B, J, 3, 4): R and o of each joint.
    """
    turns = [rotations[:, 0]]
    shifts = [joints[:, 0] - (turns[0] @ joints[:, 0, :, None])[..., 0]]
    for joint, parent in enumerate(parents[1:], start=1):
        turns.append(turns[parent] @ rotations[:, joint])
        bend = (turns[parent] - turns[joint]) @ joints[:, joint, :, None]
        shifts.append(shifts[parent] + bend[..., 0])
    batch = max(rotations.shape[0], joints.shape[0])
    columns = [
        torch.cat([turn.expand(batch, 3, 3), shift[..., None].expand(batch, 3, 1)], dim=-1)
        for turn, shift in zip(turns, shifts)
    ]
    return torch.stack(columns, dim=1)


def _rows(values: Tensor) -> Tensor:
    """(B, n), with a batch axis added to a vector."""
    return values if values.ndim > 1 else values[None]


BATCH = 64
"""Number of poses evaluated at once, to limit memory for long sequences."""


class PosedSubject:
    """One identity of a head model. ``shape``: (S,) identity coefficients. ``static_offset``: (V, 3) metres."""

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
        """(T, V, 3) vertices in the world, metres."""
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
        """(T, 4, 4) rigid motion of the head, from the frame with the neck joint at rest to the world, metres."""

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


def frontal_key(clip: Clip, timestep: int) -> FrameKey:
    """Training frame of a timestep from the most frontal camera."""
    pose = clip.poses[timestep]
    facing = rotation_of(pose.rotation).apply([0.0, 0.0, 1.0])

    def directness(key: FrameKey) -> float:
        towards = clip.cameras[key.camera].center - pose.translation
        return float(facing @ towards / np.linalg.norm(towards))

    return max((key for key in clip.splits["train"] if key.timestep == timestep), key=directness)
