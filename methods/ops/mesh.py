"""Frames of the triangles of a posed mesh.

Qian et al., "GaussianAvatars: Rigged 3D Gaussian Splatting", CVPR 2024, section 3.2, with the frame of its code.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...bench.native.dispatch import Operation
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
    # Separate coordinates of (3, F) are several times faster on the CPU than rows of three.
    corners = vertices.t().contiguous().index_select(1, faces.t().reshape(-1)).view(3, 3, -1)
    origin = corners[:, 0]
    base = corners[:, 1] - origin
    side = corners[:, 2] - origin
    base_length = _length(base)
    along = base / base_length
    normal = _unit(_cross(along, side))
    across = -_unit(_cross(normal, along))
    height = (across * side).sum(0).abs()
    rotation = torch.stack([along, normal, across], dim=1).permute(2, 0, 1).contiguous()
    size = 0.5 * (base_length + height)
    return TriangleFrames(rotation, corners.mean(1).t().contiguous(), size, matrix_to_quaternion(rotation))


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


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross products of (3, F) vectors."""
    (ax, ay, az), (bx, by, bz) = a.unbind(0), b.unbind(0)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _length(vectors: Tensor) -> Tensor:
    """(F,) lengths of (3, F) vectors, at least `NORM_FLOOR`, where the gradient is 0."""
    return vectors.square().sum(0).clamp_min(NORM_FLOOR**2).sqrt()


def _unit(vectors: Tensor) -> Tensor:
    return vectors / _length(vectors)
