"""The driving signal as GHA takes it: an expression code, and the rigid motion of the head with its own code.

The published model knows a face model without joints. Here the expression code is expression, jaw and eyes (and
eyelids, where the head model has them), and the rigid motion is the one that the head model's root and neck give.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import FloatArray, HeadAsset, HeadPose
from ...datasets.head.arrays import check_size
from ...datasets.head.model import HeadModel
from ...datasets.head.rotations import (
    axis_angle_to_matrix,
    axis_angle_to_quaternion,
    matrix_to_axis_angle,
    quaternion_to_axis_angle,
)

POSE_SIZE = 6
"""Axis-angle and translation."""

ANGLES = 9
"""Of jaw and eyes in the expression code, after the expression."""


class Signal(NamedTuple):
    """One timestep.

    Attributes
    ----------
    expression : (E,) expression code.
    rotation, neck, translation : (3,) each, as tracked.
    joints : (2, 3) root and neck of the unposed head, metres.
    """

    expression: Tensor
    rotation: Tensor
    neck: Tensor
    translation: Tensor
    joints: Tensor


class Motion(NamedTuple):
    """Where the head is.

    Attributes
    ----------
    rotation : (3, 3) canonical frame to world.
    translation : (3,) of the canonical frame's origin, metres.
    code : (6,) axis-angle and translation, what networks see of it.
    """

    rotation: Tensor
    translation: Tensor
    code: Tensor


class Driver:
    """Turns poses of one subject into signals and motions.

    The canonical frame has the axes of the unposed head, its origin at the centre of the neutral landmarks, and a
    unit of ``unit`` metres: x_world = R (unit x) + T.

    Parameters
    ----------
    shape, static_offset : (S,) identity and (V, 3) metres.
    expression_scale : (E,) that the expression code is divided by; None for ones.
    origin : (3,) of the canonical frame in the unposed head, metres.
    """

    def __init__(
        self,
        head: HeadAsset,
        shape: FloatArray,
        static_offset: FloatArray,
        origin: FloatArray,
        unit: float,
        expression_scale: Tensor | None,
        device: str,
    ):
        self.model = HeadModel(head, device=device)
        self._identity = {
            "shape": torch.as_tensor(np.asarray(shape)).to(self.model.template),
            "static_offset": torch.as_tensor(np.asarray(static_offset)).to(self.model.template),
        }
        self.neutral = self.model.canonical(**self._identity)[0]
        check_size("subject", "shape, static_offset", self.neutral.cpu().numpy(), np.asarray(head.faces))
        self.origin = torch.as_tensor(np.asarray(origin)).to(self.neutral)
        self.unit = unit
        self.expression_scale = expression_scale

    def arguments(self, poses: Sequence[HeadPose]) -> dict[str, Tensor]:
        """Driving signal as tensors with a batch axis. Raises `InputError` for another head model's pose."""
        return self.model.pose_arguments(poses)

    @torch.no_grad()
    def signals(self, arguments: Mapping[str, Tensor]) -> list[Signal]:
        """One signal for each timestep of the arguments."""
        codes = expression_codes(arguments)
        if self.expression_scale is not None:
            codes = codes / self.expression_scale
        signals = []
        for t in range(len(codes)):
            # One at a time, so that a pose gives the same bits in any company.
            joints = self.model.joints(expression=arguments["expression"][t : t + 1], **self._identity)
            rigid = {name: arguments[name][t] for name in ("rotation", "neck", "translation")}
            signals.append(Signal(codes[t], **rigid, joints=joints[0, :2]))
        return signals

    def motion(self, signal: Signal, correction: Tensor | None = None) -> Motion:
        """Rigid motion of the head; differentiable in the (6,) correction of rotation and translation."""
        turn, shift = signal.rotation, signal.translation
        if correction is not None:
            turn, shift = turn + correction[:3], shift + correction[3:]
        root, neck = axis_angle_to_matrix(torch.stack([turn, signal.neck]))
        base, joint = signal.joints
        rotation = root @ neck
        translation = base + shift + root @ (joint - base) + rotation @ (self.origin - joint)
        return Motion(rotation, translation, torch.cat([matrix_to_axis_angle(rotation), translation]))

    def still(self, codes: Tensor) -> dict[str, Tensor]:
        """Arguments of (B, E) expression codes with the head at rest: the inverse of what `signals` makes of them."""
        if self.expression_scale is not None:
            codes = codes * self.expression_scale
        rest = codes.new_zeros(len(codes), 3)
        still = {"rotation": rest, "neck": rest, "translation": rest}
        return {**still, **code_arguments(codes, self.model.expression_size)}

    def canonical(self, vertices: Tensor) -> Tensor:
        """Canonical coordinates of (..., 3) points of the unposed head, metres."""
        return (vertices - self.origin) / self.unit

    def unposed(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(T, V, 3) vertices with expression, jaw, eyes and eyelids alone, canonical coordinates."""
        still = {name: torch.zeros_like(arguments[name]) for name in ("rotation", "neck", "translation")}
        return self.canonical(self.model(canonical=self.neutral[None], **{**arguments, **still}))


def expression_codes(arguments: Mapping[str, Tensor]) -> Tensor:
    """(T, E) expression, jaw, eyes and, where there are any, eyelids; angles within half a turn."""
    parts = [arguments["expression"], _principal(arguments["jaw"])]
    parts.append(_principal(arguments["eyes"].unflatten(1, (2, 3))).flatten(1))
    if "eyelids" in arguments:
        parts.append(arguments["eyelids"])
    return torch.cat(parts, dim=1)


def code_arguments(codes: Tensor, expressions: int) -> dict[str, Tensor]:
    """The parts of (T, E) `expression_codes` by name; eyelids where there are columns for them."""
    parts = codes.split([expressions, 3, 6, codes.shape[1] - expressions - ANGLES], dim=1)
    named = dict(zip(("expression", "jaw", "eyes", "eyelids"), parts))
    return {name: values for name, values in named.items() if values.shape[1]}


def code_size(head: HeadAsset) -> int:
    """E of `expression_codes` for a head model."""
    return head.expression_basis.shape[2] + ANGLES + (0 if head.eyelid_basis is None else 2)


def _principal(axis_angle: Tensor) -> Tensor:
    """The same rotations with angles of at most pi, so that a turn too many is nothing new to a network."""
    return quaternion_to_axis_angle(axis_angle_to_quaternion(axis_angle))
