"""The differentiable head: linear blendshapes, pose correctives and skinning over any head in FLAME's layout.

Li et al., "Learning a model of facial shape and expression from 4D scans", SIGGRAPH Asia 2017, section 4;
the formulation of the skinning is that of SMPL (Loper et al., SIGGRAPH Asia 2015, section 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ...bench.contracts import FloatArray, HeadAsset, HeadPose
from ...bench.errors import InputError
from ...bench.native.dispatch import on_host, to_device
from .rotations import axis_angle_to_matrix


class HeadModel(torch.nn.Module):
    """Vertices of a head from identity, expression and pose. Batched and differentiable in every input.

    Every argument is ``(B, n)`` or ``(n,)``, and arguments of batch size 1 are broadcast. Lengths are metres,
    rotations axis-angle in radians.

    Parameters
    ----------
    asset : a head in FLAME's layout, e.g. `HeadArrays`.
    dtype, device : of the buffers; inputs have to match.
    """

    template: Tensor
    faces: Tensor
    shape_matrix: Tensor
    expression_matrix: Tensor
    pose_matrix: Tensor
    joint_regressor: Tensor
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
            self.register_buffer(
                name, torch.from_numpy(array).to(device=device, dtype=dtype), persistent=False
            )

        def basis(name: str, values: Any) -> None:
            # (V, 3, K) to (K, 3V): the product with coefficients is then one matrix multiplication.
            buffer(name, np.asarray(values).reshape(-1, np.shape(values)[2]).T)

        buffer("template", asset.template)
        basis("shape_matrix", asset.shape_basis)
        basis("expression_matrix", asset.expression_basis)
        basis("pose_matrix", asset.pose_basis)
        buffer("joint_regressor", asset.joint_regressor)
        buffer("skinning_weights", asset.skinning_weights)
        if asset.eyelid_basis is None:
            self.eyelid_matrix = None
        else:
            basis("eyelid_matrix", asset.eyelid_basis)
        self._fast = FastPosing(asset, dtype=dtype).to(device)
        faces = torch.from_numpy(np.asarray(asset.faces, dtype=np.int64)).to(device)
        self.register_buffer("faces", faces, persistent=False)

    @property
    def shape_size(self) -> int:
        """S, the number of identity coefficients."""
        return self.shape_matrix.shape[0]

    @property
    def expression_size(self) -> int:
        """E, the number of expression coefficients."""
        return self.expression_matrix.shape[0]

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

        Shaped mesh, joints regressed from it, pose correctives, linear blend skinning, translation, eyelids. On the
        CPU, where no gradient is asked for, `FastPosing` does the posing; the two agree to rounding.

        Parameters
        ----------
        shape : (B, S) identity coefficients.
        expression : (B, E).
        rotation, neck, jaw : (B, 3); ``rotation`` turns about joint 0, not about the origin.
        eyes : (B, 6) left, then right.
        translation : (B, 3).
        static_offset : (B, V, 3) or (V, 3), added to the shaped template.
        eyelids : (B, 2) left, right; only for models with eyelid bases. Added after skinning and turned with root
            and neck, so that a head moves rigidly with its lids; trackers that have them keep both at rest.
        canonical : (B, V, 3), what `canonical` gave for this identity; replaces ``shape`` and
            ``static_offset``. Worth it where the identity is fixed: the identity basis is the largest array.

        Raises
        ------
        ValueError
            Where sizes do not fit the model, or identity is given both ways or not at all.
        """
        neutral = self._neutral(shape, static_offset, canonical)
        expression = _rows(expression, self.expression_size, "expression")
        angles = self._angles(rotation, neck, jaw, eyes)
        inputs = (neutral, expression, angles, _rows(translation, 3, "translation"))
        differentiated = torch.is_grad_enabled() and any(value.requires_grad for value in inputs)
        fast = on_host(neutral) and not differentiated
        vertices = self._fast(*inputs) if fast else self._pose(*inputs)
        if eyelids is not None:
            if self.eyelid_matrix is None:
                raise ValueError(f"head model {self.version!r} has no eyelid basis, but eyelids were given")
            lids = (_rows(eyelids, 2, "eyelids") @ self.eyelid_matrix).unflatten(1, (-1, 3))
            root, own = axis_angle_to_matrix(angles[:, 0]), axis_angle_to_matrix(angles[:, 1])
            vertices = vertices + lids @ (root @ own).mT
        return vertices

    def _pose(self, neutral: Tensor, expression: Tensor, angles: Tensor, translation: Tensor) -> Tensor:
        """Skinned vertices (B, V, 3), differentiable: the formulae as they are written, and what `FastPosing` is tested by."""
        rotations = axis_angle_to_matrix(angles)
        shaped = neutral + (expression @ self.expression_matrix).unflatten(1, (-1, 3))
        joints = self.joint_regressor @ shaped
        identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        feature = (rotations[:, 1:] - identity).flatten(1)
        posed = shaped + (feature @ self.pose_matrix).unflatten(1, (-1, 3))

        world = chain_transforms(rotations, joints, self.parents)
        # What joint j adds at vertex x is R_j x + o_j; the offset takes x from the joint and back.
        offsets = world[..., 3] - (world[..., :3] @ joints[..., None])[..., 0]
        relative = torch.cat([world[..., :3], offsets[..., None]], dim=-1)
        blended = (self.skinning_weights @ relative.flatten(2)).unflatten(2, (3, 4))
        return (blended[..., :3] @ posed[..., None])[..., 0] + blended[..., 3] + translation[:, None]

    def canonical(self, shape: Tensor, static_offset: Tensor | None = None) -> Tensor:
        """Neutral, unposed head of an identity: (B, V, 3), metres."""
        blend = _rows(shape, self.shape_size, "shape") @ self.shape_matrix
        vertices = self.template + blend.unflatten(1, (-1, 3))
        if static_offset is None:
            return vertices
        if static_offset.shape[-2:] != self.template.shape:
            found = tuple(static_offset.shape)
            raise ValueError(f"static_offset: expected (..., {len(self.template)}, 3), found {found}")
        return vertices + static_offset

    def joints(self, shape: Tensor, expression: Tensor, static_offset: Tensor | None = None) -> Tensor:
        """Joint positions of the shaped, unposed head: (B, J, 3), metres."""
        expression = _rows(expression, self.expression_size, "expression")
        return self._fast.joints(self.canonical(shape, static_offset), expression)

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
        """Rigid motion of the head, (B, 4, 4): translation after the root's and the neck's rotation.

        What trackers call the head pose: vertices that hang on the neck joint alone move by it, apart from
        the pose correctives of the neck.
        """
        joints = self.joints(shape, expression, static_offset)
        still = torch.zeros_like(_rows(rotation, 3, "rotation"))
        angles = self._angles(rotation, neck, still, torch.cat([still, still], dim=-1))
        rotations = axis_angle_to_matrix(angles)
        world = chain_transforms(rotations, joints, self.parents)[:, 1]
        turn = world[..., :3]
        shift = world[..., 3] - (turn @ joints[:, 1, :, None])[..., 0] + _rows(translation, 3, "translation")
        batch = shift.shape[0]
        last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=turn.dtype, device=turn.device).expand(batch, 1, 4)
        return torch.cat([torch.cat([turn.expand(batch, 3, 3), shift[..., None]], dim=-1), last], dim=-2)

    def pose_arguments(self, poses: Sequence[HeadPose]) -> dict[str, Tensor]:
        """Poses as arguments of `forward`, in this model's dtype and on its device.

        ``eyelids`` is among them only where the model has eyelid bases (zeros for poses that lack them). Raises as
        `pose_columns`.
        """
        columns = self.pose_columns(poses)
        # One array, so that one copy takes it to a device.
        joined = torch.from_numpy(np.concatenate([*columns.values()], axis=1)).to(self.template.dtype)
        parts = to_device(joined, self.template.device).split([part.shape[1] for part in columns.values()], 1)
        return {name: part.clone() for name, part in zip(columns, parts)}

    def pose_columns(self, poses: Sequence[HeadPose]) -> dict[str, FloatArray]:
        """What `pose_arguments` gives, as float64 arrays on the host: (T, n) each.

        Raises
        ------
        InputError
            Where there is no pose, one belongs to another head model, or its sizes do not fit.
        """
        if not poses:
            raise InputError("poses", "", "at least one pose", "none")
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
            remedy = "Coefficients of one head model mean nothing to another; refit the tracking first."
            raise InputError(where, "head_model", repr(self.version), repr(pose.head_model), remedy)
        for name, size in sizes.items():
            found = np.shape(getattr(pose, name))
            if found != (size,):
                raise InputError(where, name, f"shape ({size},)", f"shape {found}")

    def _neutral(
        self, shape: Tensor | None, static_offset: Tensor | None, canonical: Tensor | None
    ) -> Tensor:
        """(B, V, 3) neutral head, given as one or as identity."""
        if (shape is None) == (canonical is None):
            raise ValueError("give the identity once: either shape or canonical")
        if canonical is None:
            assert shape is not None
            return self.canonical(shape, static_offset)
        if static_offset is not None:
            raise ValueError("canonical already holds the static offset")
        return canonical

    def _angles(self, rotation: Tensor, neck: Tensor, jaw: Tensor, eyes: Tensor) -> Tensor:
        """Axis-angle vectors in joint order, (B, J, 3)."""
        given = (rotation, 3, "rotation"), (neck, 3, "neck"), (jaw, 3, "jaw"), (eyes, 6, "eyes")
        parts = [_rows(*part) for part in given]
        batch = max(part.shape[0] for part in parts)
        return torch.cat([part.expand(batch, -1) for part in parts], dim=1).unflatten(1, (-1, 3))


def chain_transforms(rotations: Tensor, joints: Tensor, parents: Sequence[int]) -> Tensor:
    """Rigid world transforms of the joints along the joint tree.

    Parameters
    ----------
    rotations : (B, J, 3, 3) local rotation of each joint relative to its parent.
    joints : (B, J, 3) rest positions; the root stays where it is.
    parents : parent of each joint, -1 for the root; parents come first.

    Returns
    -------
    (B, J, 3, 4): world rotation and world position of each joint.
    """
    world_rotations, positions = [rotations[:, 0]], [joints[:, 0]]
    for joint, parent in enumerate(parents[1:], start=1):
        bone = (joints[:, joint] - joints[:, parent])[..., None]
        positions.append((world_rotations[parent] @ bone)[..., 0] + positions[parent])
        world_rotations.append(world_rotations[parent] @ rotations[:, joint])
    batch = max(rotations.shape[0], joints.shape[0])
    columns = [
        torch.cat([turn.expand(batch, 3, 3), place.expand(batch, 3)[..., None]], dim=-1)
        for turn, place in zip(world_rotations, positions)
    ]
    return torch.stack(columns, dim=1)


def _rows(values: Tensor, size: int, name: str) -> Tensor:
    """(B, size), with a batch axis added to a vector."""
    rows = values if values.ndim > 1 else values[None]
    if rows.ndim != 2 or rows.shape[1] != size:
        raise ValueError(f"{name}: expected (B, {size}) or ({size},), found {tuple(values.shape)}")
    return rows


class FastPosing(torch.nn.Module):
    """Posed vertices of a head from its neutral ones. On the CPU, without gradients; sizes as in `HeadModel`."""

    directions: Tensor
    joint_directions: Tensor
    joint_regressor: Tensor
    elsewhere: Tensor
    weights: Tensor

    def __init__(self, asset: HeadAsset, *, dtype: torch.dtype) -> None:
        super().__init__()
        expression = np.asarray(asset.expression_basis, dtype=np.float64)
        correctives = np.asarray(asset.pose_basis, dtype=np.float64)
        weights = np.asarray(asset.skinning_weights, dtype=np.float64)
        regressor = np.asarray(asset.joint_regressor, dtype=np.float64)
        self.parents = tuple(int(parent) for parent in asset.parents)
        self._expression_size = expression.shape[2]
        self._correctives = np.flatnonzero(correctives.any(axis=(0, 1)))
        self._base = int(weights.sum(axis=0).argmax())
        self._others = [joint for joint in range(len(self.parents)) if joint != self._base]
        stacked = np.concatenate([expression, correctives[:, :, self._correctives]], axis=2)

        def buffer(name: str, values: np.ndarray) -> None:
            tensor = torch.from_numpy(np.ascontiguousarray(values))
            tensor = tensor if values.dtype == np.int64 else tensor.to(dtype)
            self.register_buffer(name, tensor, persistent=False)

        buffer("directions", stacked.transpose(2, 1, 0).reshape(stacked.shape[2], -1))
        buffer("joint_regressor", regressor)
        by_expression = np.tensordot(regressor, expression, 1)  # (J, 3, E)
        buffer("joint_directions", by_expression.transpose(2, 0, 1).reshape(expression.shape[2], -1))
        # Stored weights sum to 1 to their own precision only: what they lack of it goes with the base's motion.
        further = np.column_stack([weights[:, self._others], weights.sum(axis=1) - 1])
        elsewhere = np.flatnonzero(further.any(axis=1))
        buffer("elsewhere", elsewhere.astype(np.int64))
        buffer("weights", further[elsewhere].T)
        self._uneven = bool(further[:, -1].any())

    @torch.no_grad()
    def forward(
        self, canonical: Tensor, expression: Tensor, axis_angles: Tensor, translation: Tensor
    ) -> Tensor:
        """(B, V, 3) skinned vertices, metres; ``axis_angles`` (B, J, 3) are relative to the joints' parents."""
        joints = self.joints(canonical, expression).numpy().astype(np.float64)
        local = Rotation.from_rotvec(axis_angles.reshape(-1, 3).numpy()).as_matrix()
        local = local.reshape(-1, len(self.parents), 3, 3)
        still = np.logical_not(np.any(axis_angles.numpy(), axis=(0, 2)))
        turns, shifts = joint_motions(local, joints, self.parents)
        points = self._unskinned(canonical, expression, local, still)
        batch = max(len(points), len(turns), len(shifts), len(translation))
        motions = np.empty((batch, len(self.parents), 3, 4))
        motions[..., :3], motions[..., 3] = turns, shifts
        base = motions[:, self._base]
        points = points.expand(batch, -1, -1)
        moved = base[..., 3:] + translation.numpy()[..., None]
        result = torch.baddbmm(self._tensor(moved), self._tensor(base[..., :3]), points)
        rows = [at for at, joint in enumerate(self._others) if not self._moves_with_base(joint, still)]
        further = [motions[:, self._others[at]] - base for at in rows]
        if self._uneven:
            rows.append(len(self._others))
            further.append(base)
        if rows and len(self.elsewhere):
            weights = self.weights if len(rows) == len(self.weights) else self.weights[rows]
            stacked = np.stack(further, axis=-1).reshape(batch, 12, len(rows))
            blended = (self._tensor(stacked) @ weights).unflatten(1, (3, 4))
            turned = (blended[:, :, :3] * points[:, None, :, self.elsewhere]).sum(2)
            result.index_add_(2, self.elsewhere, turned.add_(blended[:, :, 3]))
        return result.transpose(1, 2).contiguous()

    def joints(self, canonical: Tensor, expression: Tensor) -> Tensor:
        """(B, J, 3) joints of the shaped, unposed head, metres."""
        moved: Tensor = (expression @ self.joint_directions).unflatten(1, (-1, 3))
        return self.joint_regressor @ canonical + moved

    def _unskinned(
        self, canonical: Tensor, expression: Tensor, local: FloatArray, still: np.ndarray
    ) -> Tensor:
        """(B, 3, V) neutral head, expression and pose correctives."""
        count = self._expression_size
        neutral = canonical.transpose(1, 2).flatten(1)
        # addmm spreads what it adds to over the batch, not the product: that has to be done before.
        expression = expression.expand(max(len(expression), len(neutral)), -1)
        moving = [index for index, column in enumerate(self._correctives) if not still[column // 9 + 1]]
        if not moving:
            return torch.addmm(neutral, expression, self.directions[:count]).unflatten(1, (3, -1))
        first, last = moving[0], moving[-1] + 1  # joints at rest between them contribute zeros
        feature = (local[:, 1:] - np.eye(3)).reshape(len(local), -1)[:, self._correctives[first:last]]
        entries = self._tensor(feature)
        correctives = self.directions[count + first : count + last]
        if first == 0:
            batch = max(len(expression), len(entries))
            coefficients = torch.cat([expression.expand(batch, -1), entries.expand(batch, -1)], 1)
            return torch.addmm(neutral, coefficients, self.directions[: count + last]).unflatten(1, (3, -1))
        moved = torch.addmm(neutral, expression, self.directions[:count])
        entries = entries.expand(max(len(entries), len(moved)), -1)
        return torch.addmm(moved, entries, correctives).unflatten(1, (3, -1))

    def _tensor(self, values: FloatArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.directions.dtype)

    def _moves_with_base(self, joint: int, still: np.ndarray) -> bool:
        """Whether a joint has the motion of the base: all that is between them in the tree is at rest."""
        ours, base = self._ancestry(joint), self._ancestry(self._base)
        return all(bool(still[between]) for between in set(ours) ^ set(base))

    def _ancestry(self, joint: int) -> list[int]:
        chain = []
        while joint >= 0:
            chain.append(joint)
            joint = self.parents[joint]
        return chain


def joint_motions(
    local: FloatArray, joints: FloatArray, parents: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Rotation (B, J, 3, 3) and shift (B, J, 3) that each joint gives to points that follow it.

    Point x goes to ``R x + o``. With local rotation Q_j and parent p: R_j = R_p Q_j and
    o_j = o_p + (R_p - R_j) c_j for a joint that rests at c_j.

    Parameters
    ----------
    local : (B or 1, J, 3, 3) rotations relative to the parent.
    joints : (B or 1, J, 3) rest positions, metres.
    """
    turns = np.empty_like(local)
    shifts = np.empty((max(len(local), len(joints)), len(parents), 3))
    for joint, parent in enumerate(parents):
        place = joints[:, joint, :, None]
        if parent < 0:
            turns[:, joint] = local[:, joint]
            shifts[:, joint] = (place - local[:, joint] @ place)[..., 0]
        else:
            turns[:, joint] = turns[:, parent] @ local[:, joint]
            bend = turns[:, parent] - turns[:, joint]
            shifts[:, joint] = shifts[:, parent] + (bend @ place)[..., 0]
    return turns, shifts
