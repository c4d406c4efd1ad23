"""How a pose carries splats: what the mesh says of the points that they were put on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...bench.contracts import FloatArray, HeadAsset, HeadPose
from ...datasets.head.model import chain_transforms
from ...datasets.head.rotations import axis_angle_to_matrix, matrix_to_quaternion, quaternion_to_matrix
from ..shared.binding import left_products
from ..shared.subject_mesh import SubjectMesh
from .differences import SKINNING_STEPS, initial_turns, nearest_rotation
from .surface import SurfacePoints

PARTS = {"linear": 9, "offset": 3, "rotation": 9, "product": 16, "turn": 4, "shift": 3}
"""Columns of what a pose says of each point."""


class Carried(NamedTuple):
    """What a pose does to splats.

    Attributes
    ----------
    linear, offset : (N, 9) and (N, 3), blended transforms of the joints with eyelids and translation; x -> A x + b.
    rotation : (N, 9), the rotation in ``linear``.
    product : (N, 16), the matrix that multiplies by its quaternion from the left.
    turn : (N, 4) initial differences of rotation, blended: times the quaternion at the start.
    shift : (N, 3) initial differences of position, blended, and pose correctives; before the transform, metres.
    """

    linear: Tensor
    offset: Tensor
    rotation: Tensor
    product: Tensor
    turn: Tensor
    shift: Tensor

    @classmethod
    def of(cls, rows: Tensor) -> Carried:
        """Part the columns of `PARTS`."""
        return cls(*rows.split(list(PARTS.values()), dim=1))


class Rig:
    """Points on the surface of a subject, moved as FLAME moves it but for expressions beyond the first K.

    Parameters
    ----------
    head, shape, static_offset : of the subject, as those of `SubjectMesh`.
    points : on its neutral mesh.
    expressions : K, leading expressions that splats follow; the joints follow all.
    """

    def __init__(
        self,
        head: HeadAsset,
        shape: FloatArray,
        static_offset: FloatArray,
        points: SurfacePoints,
        expressions: int,
        device: str,
    ):
        self.mesh = SubjectMesh(head, shape, static_offset, device)
        model = self.mesh.model
        self.expressions = min(expressions, model.expression_size)
        like = model.template
        self._triangles = torch.from_numpy(points.triangles).to(device)
        self._corners = self.mesh.faces[self._triangles].t().reshape(-1)
        self._barycentric = torch.from_numpy(points.barycentric).to(like).t()[:, :, None]
        self._weights = self._at_points(model.skinning_weights)
        self.rest = self._at_points(self.mesh.canonical)
        directions = model.expression_matrix.unflatten(1, (-1, 3))
        self._joints = (model.joint_regressor @ self.mesh.canonical)[None]
        self._joint_directions = torch.einsum("jv,evc->ejc", model.joint_regressor, directions).flatten(1)
        self._basis = torch.cat([model.expression_matrix[: self.expressions], model.pose_matrix])
        basis = model.expression_matrix[: self.expressions].t().unflatten(0, (-1, 3))
        used = torch.unique(self._triangles)
        turns = initial_turns(self.mesh.canonical, basis, self.mesh.faces[used])
        self._turned = torch.searchsorted(used, self._triangles)
        self._turns = turns.flatten(0, 1)

    def arguments(self, poses: Sequence[HeadPose]) -> dict[str, Tensor]:
        """Driving signal as tensors. Raises `InputError` for another head model's pose."""
        return self.mesh.arguments(poses)

    def coefficients(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(K,) expression coefficients that drive differences."""
        return arguments["expression"][0, : self.expressions]

    @torch.no_grad()
    def carry(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """What one pose does to each point, (P, 44) in the columns of `PARTS`."""
        model, expression = self.mesh.model, arguments["expression"]
        coefficients = self.coefficients(arguments)
        angles = torch.cat([arguments[name] for name in ("rotation", "neck", "jaw", "eyes")], dim=1)
        rotations = axis_angle_to_matrix(angles.unflatten(1, (-1, 3)))
        joints = self._joints + (expression @ self._joint_directions).unflatten(1, (-1, 3))
        world = chain_transforms(rotations, joints, model.parents)[0]
        turns, places = world[:, :, :3], world[:, :, 3]
        offsets = places - (turns @ joints[0, :, :, None])[:, :, 0]
        relative = torch.cat([turns.flatten(1), offsets], dim=1)
        linear, offset = (self._weights @ relative).split([9, 3], dim=1)
        feature = (rotations[0, 1:] - torch.eye(3).to(rotations)).flatten()
        shift = self._at_points((torch.cat([coefficients, feature]) @ self._basis).view(-1, 3))
        offset = offset + arguments["translation"]
        if "eyelids" in arguments and model.eyelid_matrix is not None:
            lids = (arguments["eyelids"][0] @ model.eyelid_matrix).view(-1, 3)
            offset = offset + self._at_points(lids) @ (rotations[0, 0] @ rotations[0, 1]).t()
        # By way of the quaternion it is a rotation to rounding, however far the blended transforms were from one.
        quaternion = matrix_to_quaternion(nearest_rotation(linear.view(-1, 3, 3), SKINNING_STEPS))
        rotation, product = quaternion_to_matrix(quaternion).flatten(1), left_products(quaternion).flatten(1)
        turn = (self._turns @ coefficients).view(-1, 4)[self._turned]
        return torch.cat([linear, offset, rotation, product, turn, shift], dim=1)

    def _at_points(self, values: Tensor) -> Tensor:
        """(P, C) of (V, C) vertex values."""
        corners = values.index_select(0, self._corners).view(3, -1, values.shape[1])
        return (corners * self._barycentric).sum(0)
