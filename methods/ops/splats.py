"""Splats bound to the triangles of a mesh: transforms to world and canonical space, and directions to the camera.

Qian et al., "GaussianAvatars: Rigged 3D Gaussian Splatting", CVPR 2024, section 3.2.

The frames of triangles are those of the code of Qian et al., "GaussianAvatars: Rigged 3D Gaussian Splatting", CVPR 2024, section 3.2.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import normalize, relu

from ...bench.native.dispatch import Operation, to_device
from ...datasets.head.rotations import matrix_to_quaternion
from .kernel import KERNEL, call, empty_like

NORM_FLOOR = 1e-10
NORMAL = 1
"""Column of a frame's rotation that is the triangle's normal."""


class TriangleFrames(NamedTuple):
    """Frame of each triangle."""

    rotation: Tensor
    """(F, 3, 3); columns are an edge, the normal, and an in-plane axis away from the third vertex."""
    center: Tensor
    """(F, 3) centroid, metres."""
    size: Tensor
    """(F,) mean of base and height, metres."""
    quaternion: Tensor
    """(F, 4) quaternion of ``rotation``, real part first."""


@Operation
def triangle_frames(vertices: Tensor, faces: Tensor) -> TriangleFrames:
    """Frames of the triangles (v0, v1, v2) of a mesh.

    a0 = unit(v1 - v0), a1 = unit(a0 x (v2 - v0)), a2 = -unit(a1 x a0), R = [a0 a1 a2];
    size = (|v1 - v0| + |a2 . (v2 - v0)|) / 2. A rotation of the mesh rotates only R.

    - ``vertices``: (V, 3).
    - ``faces``: (F, 3) int64.
    """
    corners = vertices.index_select(0, faces.reshape(-1)).view(-1, 3, 3)
    base, side = (corners[:, 1:] - corners[:, :1]).unbind(1)
    base_length = _length(base)
    along = base / base_length
    upright = torch.linalg.cross(along, side)
    height = _length(upright)
    normal = upright / height
    across = torch.linalg.cross(along, normal)
    rotation = torch.stack([along, normal, across / _length(across)], dim=2)
    size = 0.5 * (base_length + height)[:, 0]
    return TriangleFrames(rotation, corners.mean(1), size, matrix_to_quaternion(rotation))


@triangle_frames.compiled(KERNEL)
def _triangle_frames(vertices: Tensor, faces: Tensor) -> TriangleFrames:
    return TriangleFrames(*_TriangleFramesOperation.apply(vertices, faces))  # type: ignore[no-untyped-call]


class _TriangleFramesOperation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(vertices, faces)
        count, empty = len(faces), vertices.new_empty
        frames = empty(count, 3, 3), empty(count, 3), empty(count), empty(count, 4)
        call("triangles", vertices, faces, *frames)
        return frames

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        vertices, faces = ctx.saved_tensors
        by_vertices = empty_like(vertices)
        call("triangles_backward", vertices, faces, *grads, by_vertices)
        return by_vertices, None


@Operation
def turns_between(to: Tensor, origin: Tensor) -> Tensor:
    """(F, 3, 3) rotations ``to`` times the transpose of ``origin``, which map directions on one mesh to the other."""
    return to @ origin.mT


@turns_between.compiled(KERNEL)
def _turns_between(to: Tensor, origin: Tensor) -> Tensor:
    return _TurnsBetween.apply(to, origin)  # type: ignore[no-untyped-call]


class _TurnsBetween(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, to: Tensor, origin: Tensor) -> Tensor:
        ctx.save_for_backward(to, origin)
        turns = empty_like(to)
        call("turns", to, origin, turns)
        return turns

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_turns: Tensor) -> tuple[Tensor, Tensor]:
        to, origin = ctx.saved_tensors
        return by_turns @ origin, by_turns.mT @ to


def chart_axes(corners: Tensor, uv_edges: Tensor) -> Tensor:
    """(F, 3, 3) axes of triangles along their texture coordinates, as columns: tangent, bitangent and normal.

    Each has unit length, but tangent and bitangent are in general not orthogonal (``face_tbn.cu`` of the authors' program of RGBAvatar).

    - ``corners``: (F, 3, 3) positions of the corners (v0, v1, v2), metres.
    - ``uv_edges``: (F, 2, 2) texture coordinates of v1 and v2 minus those of v0, as rows; not singular.
    """
    edges = corners[:, 1:] - corners[:, :1]
    along = torch.linalg.solve(uv_edges, edges)
    normal = torch.linalg.cross(edges[:, 0], edges[:, 1])
    return torch.nn.functional.normalize(torch.stack([*along.unbind(1), normal], dim=2), dim=1)


def _length(vectors: Tensor) -> Tensor:
    """(F, 1) lengths of (F, 3) vectors, at least `NORM_FLOOR`, where the gradient is 0."""
    return torch.linalg.vector_norm(vectors, dim=1, keepdim=True).clamp_min(NORM_FLOOR)


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
    rows = turns.reshape(-1, 9).index_select(0, binding)
    directions = normalize(apply_matrices(rows, center - means), dim=1)
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


def mean_over_visible(values: Tensor, visible: Tensor) -> Tensor:
    """Mean of (N,) values where (N,) ``visible`` is true; 0 if there are none."""
    weight = visible.to(values.dtype)
    return (values * weight).sum() / weight.sum().clamp_min(1)


def position_penalty(means: Tensor, visible: Tensor, threshold: float) -> Tensor:
    """Mean over visible splats of the excess of (N, 3) local positions over the threshold (triangle sizes)."""
    return mean_over_visible(relu(torch.linalg.vector_norm(means, dim=1) - threshold), visible)


def scale_penalty(log_scales: Tensor, visible: Tensor, threshold: float) -> Tensor:
    """Mean over visible splats of the norm of (N, 3) local scales' excess over the threshold.

    The norm's gradient at zero is taken as 0.
    """
    excess = relu(log_scales.exp() - threshold)
    return mean_over_visible(torch.linalg.vector_norm(excess, dim=1), visible)


@Operation
def splat_penalties(
    means: Tensor,
    log_scales: Tensor,
    visible: Tensor,
    thresholds: tuple[float, float],
    weights: tuple[float, float],
) -> Tensor:
    """Weighted sum of `position_penalty` and `scale_penalty`, with the threshold and the weight of each."""
    of_position = position_penalty(means, visible, thresholds[0])
    return weights[0] * of_position + weights[1] * scale_penalty(log_scales, visible, thresholds[1])


@splat_penalties.compiled(KERNEL)
def _splat_penalties(
    means: Tensor,
    log_scales: Tensor,
    visible: Tensor,
    thresholds: tuple[float, float],
    weights: tuple[float, float],
) -> Tensor:
    return _SplatPenalties.apply(means, log_scales, visible, *thresholds, *weights)  # type: ignore[no-untyped-call]


class _SplatPenalties(torch.autograd.Function):
    """Value and gradients in one pass; numpy's reductions of three numbers are faster than torch's."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        log_scales: Tensor,
        visible: Tensor,
        farthest: float,
        largest: float,
        *weights: float,
    ) -> Tensor:
        positions, scales, seen = means.detach().numpy(), np.exp(log_scales.detach().numpy()), visible.numpy()
        by_position, by_scale = (weight / max(int(np.count_nonzero(seen)), 1) for weight in weights)
        # Numbers that are none are not within a threshold, so that they show in the loss.
        length = np.sqrt(np.einsum("nk,nk->n", positions, positions))
        of_far = np.float32(by_position) * (seen & ~(length <= farthest))
        by_means = (of_far / np.maximum(length, np.float32(NORM_FLOOR)))[:, None] * positions
        large = np.unique(np.flatnonzero(~(scales.ravel() <= largest)) // 3)
        excess, of_large = np.maximum(scales[large] - largest, 0), by_scale * seen[large]
        size = np.sqrt((excess**2).sum(1))
        by_log_scales = np.zeros_like(scales)
        by_log_scales[large] = (of_large / np.maximum(size, NORM_FLOOR))[:, None] * excess * scales[large]
        ctx.gradients = torch.from_numpy(by_means), torch.from_numpy(by_log_scales)
        return means.new_tensor(of_far @ (length - farthest) + of_large @ size)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        by_means, by_log_scales = ctx.gradients if grad == 1 else [grad * each for each in ctx.gradients]
        return by_means, by_log_scales, None, None, None, None, None


def unturned(count: int) -> Tensor:
    """(N, 4) quaternions of no rotation, real part first."""
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return quats


@cache
def _product_matrix(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(4, 16): the entries of `left_products` for each component of a quaternion."""
    entries = torch.zeros(4, 4, 4, dtype=dtype)
    for row, columns in enumerate(["0 -1 -2 -3", "1 0 -3 2", "2 3 0 -1", "3 -2 1 0"]):
        for column, entry in enumerate(columns.split()):
            entries[abs(int(entry)), row, column] = -1 if entry.startswith("-") else 1
    return to_device(entries.view(4, 16), device)


def left_products(quaternions: Tensor) -> Tensor:
    """(F, 4, 4) matrices: ``left_products(q) @ p`` is the Hamilton product q p, real parts first."""
    return (quaternions @ _product_matrix(quaternions.dtype, quaternions.device)).view(-1, 4, 4)


def apply_matrices(rows: Tensor, vectors: Tensor) -> Tensor:
    """Products of (D, D) matrices, given as rows of (N, D D), with the vectors of (N, D)."""
    size = vectors.shape[1]
    return torch.bmm(rows.view(-1, size, size), vectors[:, :, None])[:, :, 0]
