"""Stand-ins for GaussianBlendshapes' own CUDA and C++ code, and for the packages that it imports.

Values and gradients equal those of their kernels. Their forks of the rasteriser and of ``simple_knn`` have the names
of the originals and additional functions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ....datasets.head.refit.identity import closest_points
from ...ops.harmonics import sh_basis
from ...shared.surface_points import poisson_disk
from .meshes import FILES_AND_ROTATIONS, read_obj
from .unused import Silent

FAR = 0.015
"""Distance from the nearest vertex, metres, from which a point gets that vertex instead of the nearest triangle. No
splat is initially so far from the surface."""
DIRECTIONS = 40
"""Number of directions whose values determine the 16 harmonics up to degree 3."""


# ---------------------------------------------------------------------- diff_gaussian_rasterization


def rotate_harmonics(rotations: Tensor, coefficients: Tensor) -> Tensor:
    """Harmonics (P, 16, 3) rotated by (P, 3, 3): the value at R d is the original one at d."""
    directions = _sphere(DIRECTIONS).to(coefficients)
    fitted = torch.linalg.pinv(sh_basis(_sphere(DIRECTIONS), 3)).to(coefficients)
    back = torch.einsum("pji,mj->pmi", rotations, directions).reshape(-1, 3)
    turned = sh_basis(back, 3).view(len(rotations), DIRECTIONS, 16)
    return fitted @ (turned @ coefficients)


def _sphere(count: int) -> Tensor:
    """(N, 3) float64 directions, evenly spread (a Fibonacci lattice)."""
    index = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * index + 1) / count
    angle = torch.pi * (3 - 5**0.5) * index
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)


class _Composite(torch.autograd.Function):
    """As in their code, coefficients, initial differences and mask have no gradient."""

    @staticmethod
    def forward(ctx: Any, mean: Tensor, basis: Tensor, shares: Tensor, added: Tensor) -> Tensor:
        ctx.save_for_backward(shares)
        ctx.shape = basis.shape
        points, count = shares.shape
        blended = torch.bmm(basis.reshape(points, -1, count), shares[:, :, None])
        return mean + (blended + added).view_as(mean)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (shares,) = ctx.saved_tensors
        spread = grads[0].reshape(len(shares), -1, 1) * shares[:, None]
        return grads[0], spread.view(ctx.shape), None, None


def composite_blendshape(
    mean: Tensor,
    basis: Tensor,
    coefficients: Tensor,
    initial: Tensor | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """Sum over K expressions of coefficient times (initial + mask * basis), added to the mean.

    - ``mean``: (P, ...).
    - ``basis``, ``initial``: (P, ..., K); the initial one has no gradient.
    - ``coefficients``: (K,), without gradient.
    - ``mask``: (P, K), without gradient; 1 by default.
    """
    points, count = len(mean), len(coefficients)
    shares = coefficients.expand(points, count) if mask is None else mask * coefficients
    added = mean.new_zeros(points, 1, 1)
    if initial is not None:
        added = (initial.reshape(points, -1, count) @ coefficients)[:, :, None]
    return _Composite.apply(mean, basis, shares, added)  # type: ignore[no-any-return,no-untyped-call]


def inverse(matrices: Tensor) -> Tensor:
    """(P, 3, 3) inverses, without pivoting, by cofactors."""
    a, b, c = matrices.unbind(-2)
    cofactors = torch.stack([torch.linalg.cross(*pair) for pair in ((b, c), (c, a), (a, b))], -1)
    return cofactors / (a * cofactors[..., 0]).sum(-1)[..., None, None]


@torch.no_grad()
def adam_update(
    beta1: float,
    beta2: float,
    correction1: float,
    root_correction2: float,
    step: float,
    eps: float,
    decay: float,
    parameter: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
) -> None:
    """One step of Adam in place; ``step`` is already divided by the first bias correction."""
    if decay:
        gradient = gradient + decay * parameter
    mean.mul_(beta1).add_(gradient, alpha=1 - beta1)
    square.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    parameter.addcdiv_(mean, (square.sqrt() / root_correction2).add_(eps), value=-step)


# ---------------------------------------------------------------------- simple_knn


class _Nearest(NamedTuple):
    """(M,) triangles, (M, 3) barycentric coordinates, and the query."""

    triangles: np.ndarray
    weights: np.ndarray
    asked: tuple[Tensor, Tensor, Tensor]


_last: list[_Nearest] = []


def _nearest(vertices: Tensor, faces: Tensor, points: Tensor) -> _Nearest:
    """Nearest triangles; the last result is cached because their code asks twice."""
    asked = vertices, faces, points
    if _last and all(torch.equal(old, new) for old, new in zip(_last[0].asked, asked, strict=True)):
        return _last[0]
    places, corners = vertices.double().numpy(), faces.long().numpy()
    sought = points.double().numpy()
    away, vertex = KDTree(places).query(sought, workers=torch.get_num_threads())
    first = np.zeros(len(places), np.int64)
    first[corners[::-1].ravel()] = np.repeat(np.arange(len(corners))[::-1], 3)
    triangles = first[vertex]
    weights = (corners[triangles] == vertex[:, None]).astype(np.float64)
    near = np.flatnonzero(away < FAR)
    found = closest_points(sought[near], places, corners)
    triangles[near], weights[near] = found.face, found.weights
    _last[:] = [_Nearest(triangles, weights, asked)]
    return _last[0]


def nearest_triangles(vertices: Tensor, faces: Tensor, points: Tensor, candidates: int) -> Tensor:
    """(M,) int32 triangle nearest to each of (M, 3) points; ``candidates`` is ignored."""
    return torch.from_numpy(_nearest(vertices, faces, points).triangles).int()


def nearest_features(
    vertices: Tensor, features: Tensor, faces: Tensor, points: Tensor, candidates: int
) -> Tensor:
    """(M, C) vertex features (V, C), interpolated at the points of the surface nearest to (M, 3) points."""
    found = _nearest(vertices, faces, points)
    corners = faces.long()[torch.from_numpy(found.triangles)]
    weights = torch.from_numpy(found.weights).to(features)
    summed = torch.zeros(len(points), features.shape[1])
    for corner in range(3):
        summed += weights[:, corner, None] * features[corners[:, corner]]
    return summed


def ids_and_weights(points: Tensor, grid: Tensor, align_corners: bool) -> tuple[Tensor, Tensor]:
    """Values (P, 8) of an integer grid (D, H, W) at the nodes around (P, 3) points in [-1, 1] x, y, z, and their weights."""
    sizes = torch.tensor(grid.shape[::-1])
    scaled = (points * 0.5 + 0.5) * (sizes - 1 if align_corners else sizes) - (0 if align_corners else 0.5)
    low = scaled.floor()
    part = scaled - low
    values, weights = [], []
    for corner in range(8):
        step = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        x, y, z = torch.minimum((low + step).long().clamp_min(0), sizes - 1).unbind(1)
        values.append(grid[z, y, x])
        weights.append(torch.where(step.bool(), part, 1 - part).prod(1))
    return torch.stack(values, dim=1), torch.stack(weights, dim=1)


# ---------------------------------------------------------------------- pytorch3d


class Attributes:
    """Holds its arguments: cameras and settings of a mesh renderer."""

    def __init__(self, **values: Any):
        self.__dict__.update(values)


class MeshRasterizer(Attributes):
    """Draws nothing: the image of the mesh beside a render is white."""

    def __call__(self, meshes: Any, cameras: Any) -> None:
        return None


class SoftPhongShader(Attributes):
    """White images (1, H, W, 4) of the camera's size."""

    def __call__(self, fragments: Any, meshes: Any, cameras: Any, **options: Any) -> Tensor:
        return torch.ones(1, *cameras.image_size[0], 4)


# ---------------------------------------------------------------------- point_cloud_utils, tensorboard


def load_mesh(path: str) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) vertices and (F, 3) triangles of an OBJ file."""
    found = read_obj(path)
    return found.vertices, found.faces


def sample_mesh_poisson_disk(
    vertices: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """About ``count`` points on a mesh, no two of them close: (P,) triangles and (P, 3) barycentric coordinates.

    Coordinates have the dtype of the vertices.
    """
    found = poisson_disk(vertices, faces, np.arange(len(faces)), count, 0)
    return found.triangles, found.barycentric.astype(vertices.dtype)


RASTERIZER: dict[str, Any] = {
    "RotSH3_C3": rotate_harmonics,
    "CompositeBlendShape": composite_blendshape,
    "InvMat3x3": inverse,
}
RASTERIZER_KERNELS: dict[str, Any] = {"AdamUpdate": adam_update}
NEIGHBOURS: dict[str, Any] = {
    "getNearestTriangleID": nearest_triangles,
    "getNearestFeature": nearest_features,
    "getIdAndWeight": ids_and_weights,
}
PACKAGES: dict[str, dict[str, Any]] = {
    **FILES_AND_ROTATIONS,
    "pytorch3d.structures": {"Meshes": Attributes},
    "pytorch3d.renderer": {
        **dict.fromkeys(
            (
                *("RasterizationSettings", "PointLights", "MeshRenderer", "TexturesVertex", "BlendParams"),
                "PerspectiveCameras",
            ),
            Attributes,
        ),
        "MeshRasterizer": MeshRasterizer,
        "SoftPhongShader": SoftPhongShader,
        "look_at_view_transform": None,
    },
    "point_cloud_utils": {
        "sample_mesh_poisson_disk": sample_mesh_poisson_disk,
        "load_mesh_vf": load_mesh,
    },
    "torch.utils.tensorboard": {"SummaryWriter": Silent},
}
"""Stand-in modules for packages that are not installed, by name."""
