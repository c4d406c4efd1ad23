"""Posing without gradients on the CPU: what `HeadModel`'s readable path computes, with the work the pose needs.

What is saved against the formulae as they are written, all of it exact:

* directions of the bases that are zero everywhere (most pose correctives of some heads) are left out, and with
  them the correctives of joints that are at rest;
* neutral head, expression and correctives are one matrix product, and joints follow from the expression by a small
  one of their own;
* every vertex moves with the joint that carries most of the head, which is one rotation for all; other joints add
  their difference to that, only at vertices where there is one with weight, and only those that move otherwise;
* coordinates are stored by component, (3, V), so that the rotations run along memory;
* what is small (rotations, the joint tree) is done in numpy, in float64: calls cost more than arithmetic there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ...bench.contracts import FloatArray, HeadAsset


class FastPosing(torch.nn.Module):
    """Posed vertices of a head from its neutral ones. On the CPU, without gradients.

    Parameters
    ----------
    asset : a head in FLAME's layout.
    dtype : of the buffers.
    """

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
        """(B, V, 3) skinned vertices, metres. Arguments of batch size 1 stand for all.

        Parameters
        ----------
        canonical : (B, V, 3) neutral head, metres.
        expression : (B, E).
        axis_angles : (B, J, 3) of the joints relative to their parents.
        translation : (B, 3) metres.
        """
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
