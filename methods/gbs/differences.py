"""What a mesh's expressions say about splats before any training: their turning, and where differences matter.

Ma et al., "3D Gaussian Blendshapes for Head Avatar Animation", SIGGRAPH 2024, sections 3.2 and 3.3. The gradients
of deformation are those of Sumner and Popovic, "Deformation transfer for triangle meshes", SIGGRAPH 2004, section 3.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import FloatArray, IntArray
from ...datasets.head.arrays import HeadArrays
from ...datasets.head.geometry import rigid_alignment
from ...datasets.head.rotations import matrix_to_quaternion

POLAR_STEPS = 8
"""Steps of `nearest_rotation` for gradients of deformation; an error of 1 becomes 1e-12 in six."""
SKINNING_STEPS = 3
"""Steps for blended joint transforms, which are nearly rotations; as published."""
SMALLEST = 1e-12


def deformation_gradients(rest: Tensor, moved: Tensor) -> Tensor:
    """(..., 3, 3) linear maps that take each triangle, with its normal, to where it has moved.

    A fourth vertex off the triangle at n / sqrt(|n|), n being the cross product of its edges, makes the map unique
    (Sumner and Popovic, eq. 1 to 3). It takes a point x of the rest triangle's plane to ``Q (x - v0) + v0'``. A
    triangle without area has no such map and gets the identity.

    Parameters
    ----------
    rest : (F, 3, 3) corners, metres.
    moved : (..., F, 3, 3) corners.
    """
    inverse, singular = torch.linalg.inv_ex(_edges(rest))
    maps = _edges(moved) @ inverse
    return torch.where(singular[:, None, None] == 0, maps, torch.eye(3, dtype=maps.dtype, device=maps.device))


def _edges(corners: Tensor) -> Tensor:
    """(..., 3, 3) matrices whose columns are two edges and the direction of the fourth vertex."""
    one, other = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    normal = torch.linalg.cross(one, other)
    length = torch.linalg.vector_norm(normal, dim=-1, keepdim=True).clamp_min(SMALLEST)
    return torch.stack([one, other, normal / length.sqrt()], dim=-1)


def nearest_rotation(matrices: Tensor, steps: int) -> Tensor:
    """Rotation part of (..., 3, 3) matrices of positive determinant: the orthogonal factor of the polar decomposition.

    Newton's iteration R <- (R + R^-T) / 2 (Higham, "Computing the polar decomposition - with applications", SIAM J.
    Sci. Stat. Comput. 1986). Matrices that are singular in working precision stay finite and are not rotations.
    """
    for _ in range(steps):
        a, b, c = matrices.unbind(-2)
        cofactors = torch.stack(
            [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -2
        )
        determinant = (a * cofactors[..., 0, :]).sum(-1)[..., None, None]
        safe = torch.where(determinant.abs() < 1e-6, torch.full_like(determinant, 1e-6), determinant)
        matrices = 0.5 * (matrices + cofactors / safe)
    return matrices


def initial_turns(vertices: Tensor, basis: Tensor, faces: Tensor) -> Tensor:
    """(F, 4, K) quaternions, less the one of no rotation: how each expression at coefficient 1 turns each triangle.

    Times the quaternion of a splat at its start they are the published initial differences of rotation; differences
    add up over expressions, and the sum is normalised.

    Parameters
    ----------
    vertices : (V, 3) neutral mesh, metres.
    basis : (V, 3, K) metres per unit coefficient.
    faces : (F, 3) int64.
    """
    rest = vertices.to(torch.float64)[faces]
    turns = torch.zeros(len(faces), 4, basis.shape[2], dtype=torch.float64, device=vertices.device)
    for k in range(basis.shape[2]):
        moved = rest + basis[:, :, k].to(torch.float64)[faces]
        turns[:, :, k] = matrix_to_quaternion(
            nearest_rotation(deformation_gradients(rest, moved), POLAR_STEPS)
        )
    turns[:, 0] -= 1
    return turns.to(vertices.dtype)


def consistency_mask(
    head: HeadArrays, vertices: FloatArray, expressions: int, floor: float, full: float
) -> FloatArray:
    """(F, K) weight, not negative, with which an expression may change the splats of a triangle.

    max(0, (D - floor) / (full - floor)), not bounded above, where D is how far an expression at coefficient 1 moves
    the triangle's centroid. The back of the head is held in place first (a rigid motion in an expression is none of
    its own), and the neck never moves.

    Parameters
    ----------
    vertices : (V, 3) neutral mesh.
    expressions : K, how many of the leading expressions.
    floor, full : metres.
    """
    still = head.regions.get("scalp", np.empty(0, np.int64))
    neck = head.regions.get("neck", np.empty(0, np.int64))
    # Teeth have no expressions of their own; held in place with the scalp they would seem to have.
    teeth = head.regions.get("teeth", np.empty(0, np.int64))
    vertices = np.asarray(vertices, np.float64)
    mask = np.empty((len(head.faces), expressions))
    for k in range(expressions):
        moved = vertices + head.expression_basis[:, :, k]
        if len(still) >= 3:
            motion = rigid_alignment(moved[still], vertices[still])
            moved = moved @ motion[:3, :3].T + motion[:3, 3]
        displacement = moved - vertices
        displacement[np.concatenate([neck, teeth])] = 0
        distance = np.linalg.norm(displacement[head.faces].mean(1), axis=1)
        mask[:, k] = np.maximum(0.0, (distance - floor) / (full - floor))
    return mask


def entries_of(mask: FloatArray, triangles: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """The mask at points of the surface without its zeros: (P,) counts, and (M,) expressions and weights in order."""
    at_points = mask[triangles]
    _, columns = np.nonzero(at_points)
    return (at_points > 0).sum(1), columns, at_points[at_points > 0]
