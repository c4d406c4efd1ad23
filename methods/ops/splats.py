"""Splats bound to the triangles of a mesh: transforms to world and canonical space, and directions to the camera.

Qian et al., "GaussianAvatars: Rigged 3D Gaussian Splatting", CVPR 2024, section 3.2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import normalize

from ...bench.native.dispatch import Operation
from .kernel import KERNEL, call, empty_like
from .mesh import TriangleFrames


class WorldSplats(NamedTuple):
    """Splats in the world: (N, 3) means, (N, 4) unit quaternions wxyz, (N, 3) scales; metres."""

    means: Tensor
    quats: Tensor
    scales: Tensor


class Activated(NamedTuple):
    """Activated parameters of local splats: (N, 3) scales and (N, 4) unit quaternions wxyz."""

    scales: Tensor
    quats: Tensor


@Operation
def activate(log_scales: Tensor, quats: Tensor) -> Activated:
    """Scales of (N, 3) logarithms and unit quaternions of (N, 4) of any length. The compiled form has no gradients."""
    return Activated(
        log_scales.exp(), quats / torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min(1e-12)
    )


@activate.compiled(KERNEL)
def _activate(log_scales: Tensor, quats: Tensor) -> Activated:
    activated = Activated(empty_like(log_scales), empty_like(quats))
    call("activate", log_scales, quats, *activated)
    return activated


@Operation
def to_world(
    frames: TriangleFrames,
    binding: Tensor,
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    activated: Activated | None = None,
) -> WorldSplats:
    """Transform local splats to world space: mean' = k R mean + T, scale' = k exp(s), q' = q(R) q/|q|.

    - ``binding``: (N,) int64, the triangle of each splat.
    - ``means``: (N, 3) in units of the triangle's size.
    - ``log_scales``: (N, 3) logarithms in the same unit.
    - ``quats``: (N, 4), real part first, of any length.
    - ``activated``: activations of ``log_scales`` and ``quats``, if these are constant over frames and no gradient is needed.
    """
    linear = (frames.size[:, None, None] * frames.rotation).flatten(1)
    # One gather instead of four, and one scatter for its gradient. The quaternion is passed as the matrix of
    # multiplication by it: products of small matrices are several times faster than sums over columns.
    turn = left_products(frames.quaternion).flatten(1)
    packed = torch.cat([linear, frames.center, frames.size[:, None], turn], dim=1)
    linear, center, size, turn = packed.index_select(0, binding).split([9, 3, 1, 16], dim=1)
    world_means = apply_matrices(linear, means) + center
    scales, units = activated or activate.definition(log_scales, quats)
    return WorldSplats(world_means, apply_matrices(turn, units), size * scales)


@to_world.compiled(KERNEL)
def _to_world(
    frames: TriangleFrames,
    binding: Tensor,
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    activated: Activated | None = None,
) -> WorldSplats:
    activated = activated or _activate(log_scales, quats)
    return WorldSplats(*_ToWorld.apply(*frames, means, log_scales, quats, binding, *activated))  # type: ignore[no-untyped-call]


class _ToWorld(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, ...]:
        *frames, means, _, quats, binding, scales, units = inputs
        ctx.save_for_backward(binding, *frames, means, quats, scales)
        world = empty_like(means), empty_like(units), empty_like(scales)
        call("to_world", binding, *frames, means, units, scales, *world)
        return world

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        binding, *frames, means, quats, scales = ctx.saved_tensors
        wanted = any(ctx.needs_input_grad[:4])
        by_frames = [empty_like(value) if wanted else None for value in frames]
        by_means, by_quats, by_log_scales = (empty_like(value) for value in (means, quats, scales))
        given = binding, *frames, means, quats, scales, *grads
        call("to_world_backward", *given, by_means, by_quats, by_log_scales, *by_frames)
        return *by_frames, by_means, by_log_scales, by_quats, None, None, None


@Operation
def points_on(means: Tensor, binding: Tensor, linear: Tensor, center: Tensor) -> Tensor:
    """Positions (N, 3) on a mesh of local means: A mean + c. In the compiled form only ``means`` receive a gradient.

    - ``binding``: (N,) int64, the triangle of each splat.
    - ``linear``, ``center``: (F, 9) size times rotation, and (F, 3), by triangle.
    """
    return apply_matrices(linear.index_select(0, binding), means) + center.index_select(0, binding)


@points_on.compiled(KERNEL)
def _points_on(means: Tensor, binding: Tensor, linear: Tensor, center: Tensor) -> Tensor:
    return _PointsOn.apply(means, binding, linear, center)  # type: ignore[no-untyped-call]


class _PointsOn(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, *fixed: Tensor) -> Tensor:
        positions = empty_like(means)
        call("position_training", *fixed, means, positions, False)
        ctx.save_for_backward(*fixed)
        return positions

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_positions: Tensor) -> tuple[Tensor | None, ...]:
        by_means = empty_like(by_positions)
        call("position_training", *ctx.saved_tensors, by_positions, by_means, True)
        return by_means, None, None, None


@Operation
def directions_to(
    means: Tensor, center: Tensor, turns: Tensor, binding: Tensor, last: Tensor | None = None
) -> Tensor:
    """Unit vectors (N, 3) from world means to the camera, rotated by triangle. In the compiled form only ``means``
    receive a gradient.

    - ``center``: (3,) position of the camera.
    - ``turns``, ``binding``: (F, 3, 3) rotations by triangle, and (N,) int64, the triangle of each splat.
    - ``last``: (3, 3) applied to all directions afterwards; None for no rotation.
    """
    directions = normalize(center - means, dim=1)
    rows = turns.reshape(-1, 9).index_select(0, binding)
    directions = normalize(apply_matrices(rows, directions), dim=1)
    return directions if last is None else directions @ last.t()


@directions_to.compiled(KERNEL)
def _directions_to(
    means: Tensor, center: Tensor, turns: Tensor, binding: Tensor, last: Tensor | None = None
) -> Tensor:
    last = torch.eye(3) if last is None else last
    return _DirectionsTo.apply(means, binding, turns, last, center)  # type: ignore[no-untyped-call]


class _DirectionsTo(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, *fixed: Tensor) -> Tensor:
        directions = empty_like(means)
        call("direction_training", *fixed, means, None, directions)
        ctx.save_for_backward(*fixed, means)
        return directions

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_directions: Tensor) -> tuple[Tensor | None, ...]:
        by_means = empty_like(by_directions)
        call("direction_training", *ctx.saved_tensors, by_directions, by_means)
        return by_means, None, None, None, None


def unturned(count: int) -> Tensor:
    """(N, 4) quaternions of no rotation, real part first."""
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return quats


def left_products(quaternions: Tensor) -> Tensor:
    """(F, 4, 4) matrices: ``left_products(q) @ p`` is the Hamilton product q p, real parts first."""
    w, x, y, z = quaternions.unbind(1)
    rows = [(w, -x, -y, -z), (x, w, -z, y), (y, z, w, -x), (z, -y, x, w)]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def apply_matrices(rows: Tensor, vectors: Tensor) -> Tensor:
    """Products of (D, D) matrices, given as rows of (N, D D), with the vectors of (N, D)."""
    size = vectors.shape[1]
    return torch.bmm(rows.view(-1, size, size), vectors[:, :, None])[:, :, 0]
