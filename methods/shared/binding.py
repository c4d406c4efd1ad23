"""Splats bound to the triangles of a posed mesh: local frames and the way to the world.

Qian et al., "GaussianAvatars: Rigged 3D Gaussian Splatting", CVPR 2024, section 3.2, with the frame of its code.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ...datasets.head.rotations import matrix_to_quaternion

NORM_FLOOR = 1e-10
NORMAL = 1
"""Column of a frame's rotation that is the triangle's normal."""


class Frames(NamedTuple):
    """Frame of each triangle.

    Attributes
    ----------
    rotation : (F, 3, 3); columns are an edge, the normal, and an in-plane axis away from the third vertex.
    center : (F, 3) centroid, metres.
    size : (F,) mean of base and height, metres.
    quaternion : (F, 4) of ``rotation``, real part first.
    """

    rotation: Tensor
    center: Tensor
    size: Tensor
    quaternion: Tensor


class WorldSplats(NamedTuple):
    """Splats in the world: (N, 3) means, (N, 4) unit quaternions wxyz, (N, 3) scales; metres."""

    means: Tensor
    quats: Tensor
    scales: Tensor


def triangle_frames(vertices: Tensor, faces: Tensor) -> Frames:
    """Frames of the triangles (v0, v1, v2) of a mesh.

    a0 = unit(v1 - v0), a1 = unit(a0 x (v2 - v0)), a2 = -unit(a1 x a0), R = [a0 a1 a2];
    size = (|v1 - v0| + |a2 . (v2 - v0)|) / 2. A rotation of the mesh rotates R, and nothing else changes.

    Parameters
    ----------
    vertices : (V, 3).
    faces : (F, 3) int64.
    """
    # Coordinates apart, (3, F) each: several times faster on the CPU than rows of three.
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
    return Frames(rotation, corners.mean(1).t().contiguous(), size, matrix_to_quaternion(rotation))


def to_world(
    frames: Frames, binding: Tensor, means: Tensor, log_scales: Tensor, quats: Tensor
) -> WorldSplats:
    """Transform local splats to world space: mean' = k R mean + T, scale' = k exp(s), q' = q(R) q/|q|.

    Parameters
    ----------
    binding : (N,) int64, the triangle of each splat.
    means : (N, 3) in units of the triangle's size.
    log_scales : (N, 3) logarithms in the same unit.
    quats : (N, 4), real part first, of any length.
    """
    linear = (frames.size[:, None, None] * frames.rotation).flatten(1)
    # One gather instead of four, and one scatter for its gradient. The quaternion goes along as the matrix that
    # multiplies by it: products of small matrices are several times faster than sums over columns.
    turn = left_products(frames.quaternion).flatten(1)
    packed = torch.cat([linear, frames.center, frames.size[:, None], turn], dim=1)
    linear, center, size, turn = packed.index_select(0, binding).split([9, 3, 1, 16], dim=1)
    world_means = apply_matrices(linear, means) + center
    local = quats / torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min(1e-12)
    return WorldSplats(world_means, apply_matrices(turn, local), size * log_scales.exp())


def left_products(quaternions: Tensor) -> Tensor:
    """(F, 4, 4) matrices: ``left_products(q) @ p`` is the Hamilton product q p, real parts first."""
    w, x, y, z = quaternions.unbind(1)
    rows = [(w, -x, -y, -z), (x, w, -z, y), (y, z, w, -x), (z, -y, x, w)]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def apply_matrices(rows: Tensor, vectors: Tensor) -> Tensor:
    """Product of each (D, D) matrix, given as a row of (N, D D), with its vector of (N, D)."""
    size = vectors.shape[1]
    return torch.bmm(rows.view(-1, size, size), vectors[:, :, None])[:, :, 0]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross products of (3, F) vectors."""
    (ax, ay, az), (bx, by, bz) = a.unbind(0), b.unbind(0)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _length(vectors: Tensor) -> Tensor:
    """(F,) lengths of (3, F) vectors, `NORM_FLOOR` at least, where the gradient is 0."""
    return vectors.square().sum(0).clamp_min(NORM_FLOOR**2).sqrt()


def _unit(vectors: Tensor) -> Tensor:
    return vectors / _length(vectors)
