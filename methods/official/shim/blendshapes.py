"""Stand-ins for GaussianBlendshapes' own CUDA and C++ code, and for the packages that it imports.

Values and gradients equal those of their kernels. Their forks of the rasteriser and of ``simple_knn`` have the names
of the originals and additional functions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor, nn

from ....bench.contracts import FloatArray, IntArray
from ....datasets.head.refit.identity import closest_points
from ...ops.planes import sh_basis
from ...shared.surface_points import poisson_disk


class PerceptualLoss(nn.Module):
    """Replaces the perceptual loss, whose weights are unavailable; calling it is an error."""

    def __init__(self, **options: Any):
        super().__init__()

    def forward(self, *images: Tensor) -> Tensor:
        """Raises `NotImplementedError`: runs that would use the loss are refused earlier."""
        raise NotImplementedError("the shim has no perceptual loss")


class Node:
    """``yacs``'s node of a configuration: attributes that are assigned."""

    def clone(self) -> Node:
        """The node with the same attributes."""
        copied = Node()
        copied.__dict__.update(self.__dict__)
        return copied


class Silent:
    """Ignores all calls, like a null logger."""

    def __init__(self, *arguments: Any, **options: Any):
        pass

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *arguments, **options: None


OF_FLASHAVATAR: dict[str, dict[str, Any]] = {
    "yacs": {},
    "yacs.config": {"CfgNode": Node},
    "loguru": {"logger": Silent()},
    "skimage": {},
    "skimage.io": {"imread": None},
}
"""Stand-in modules for packages that are not installed, by name."""
REPLACED: dict[str, dict[str, Any]] = {"lpips": {"LPIPS": PerceptualLoss}}
"""Stand-ins used even if the package is installed: LPIPS downloads weights on construction."""


SMALLEST_AREA = 1e-8
"""Twice the area, in normalised device coordinates, up to which a triangle is left out, as published."""


# ---------------------------------------------------------------------- rotations


def rotation_6d_to_matrix(six: Tensor) -> Tensor:
    """(..., 3, 3) rotations whose first two rows are (..., 6) numbers, made orthonormal (Zhou et al., CVPR 2019)."""
    first, second = six[..., :3], six[..., 3:]
    x = torch.nn.functional.normalize(first, dim=-1)
    y = torch.nn.functional.normalize(second - (x * second).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-2)


def matrix_to_rotation_6d(matrices: Tensor) -> Tensor:
    """(..., 6) first two rows of (..., 3, 3) rotations."""
    return matrices[..., :2, :].clone().reshape(*matrices.shape[:-2], 6)


# ---------------------------------------------------------------------- OBJ files


class Faces(NamedTuple):
    """Triangles of an OBJ file: (F, 3) int64 vertices and texture coordinates of their corners, -1 for none."""

    verts_idx: Tensor
    textures_idx: Tensor


class Auxiliary(NamedTuple):
    """(T, 2) texture coordinates of an OBJ file; None if it has none."""

    verts_uvs: Tensor | None


class ObjFile(NamedTuple):
    """(V, 3) vertices, (T, 2) texture coordinates, and both of the corners of the triangles, (F, 3) from 0; -1 for none."""

    vertices: FloatArray
    uv: FloatArray
    faces: IntArray
    uv_faces: IntArray


def read_obj(path: str) -> ObjFile:
    """The content of an OBJ file of triangles."""
    lines = [line.split() for line in open(path, encoding="utf-8")]  # noqa: SIM115
    vertices, uv = (
        [[float(word) for word in words[1 : 1 + size]] for words in lines if words[:1] == [name]]
        for name, size in (("v", 3), ("vt", 2))
    )
    corners = [[corner.split("/") for corner in words[1:4]] for words in lines if words[:1] == ["f"]]
    faces = [[int(corner[0]) - 1 for corner in face] for face in corners]
    charted = [
        [int(corner[1]) - 1 if len(corner) > 1 and corner[1] else -1 for corner in face] for face in corners
    ]
    return ObjFile(np.array(vertices), np.array(uv), np.array(faces, np.int64), np.array(charted, np.int64))


def load_obj(path: str, load_textures: bool = False) -> tuple[Tensor, Faces, Auxiliary]:
    """Vertices (V, 3), triangles and texture coordinates of an OBJ file; materials are not read."""
    mesh = read_obj(path)
    uv = torch.from_numpy(mesh.uv).float() if len(mesh.uv) else None
    faces = Faces(torch.from_numpy(mesh.faces), torch.from_numpy(mesh.uv_faces))
    return torch.from_numpy(mesh.vertices).float(), faces, Auxiliary(uv)


# ---------------------------------------------------------------------- rasterisation of a mesh


class Mesh:
    """One mesh: (1, V, 3) vertices in normalised device coordinates, and (1, F, 3) triangles."""

    def __init__(self, verts: Tensor, faces: Tensor):
        if len(verts) != 1 or len(faces) != 1:
            raise ValueError("expected one mesh; the shim does not support several")
        self.verts, self.faces = verts[0], faces[0]


def rasterize_meshes(
    meshes: Mesh,
    image_size: int,
    blur_radius: float = 0.0,
    faces_per_pixel: int = 1,
    perspective_correct: bool = False,
    **without_effect: Any,
) -> tuple[Tensor, Tensor, Tensor, None]:
    """The first triangle in the centre of each pixel of a square image, in PyTorch3D's conventions.

    Normalised device coordinates run from 1 to -1 to the right and downwards. A triangle has the pixels whose centres are strictly
    inside it, in either orientation; of several that with the smallest z, then that with the smallest index. Triangles behind
    z = 0 and triangles without area have none. Barycentric coordinates are exact; those of PyTorch3D divide by an area that
    is larger by `SMALLEST_AREA`.

    - ``image_size``: pixels of a side, S.
    - Returns (1, S, S, 1) int64 triangle, -1 for none; (1, S, S, 1) float32 z; (1, S, S, 1, 3) float32 barycentric coordinates,
      -1 without a triangle; nothing in place of distances.
    """
    if blur_radius or faces_per_pixel != 1 or perspective_correct:
        raise ValueError("expected one triangle for each pixel, without blur and perspective correction")
    corners = meshes.verts.detach().double().numpy()[meshes.faces.numpy()]
    # (F, 3, 2) columns and rows of the corners; a pixel's centre has whole numbers.
    places = ((1 - corners[..., :2]) * image_size - 1) / 2
    doubled = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    first = np.ceil(places.min(1)).clip(0, image_size).astype(np.int64)
    last = np.floor(places.max(1)).clip(-1, image_size - 1).astype(np.int64)
    sides = np.where((np.abs(doubled) > SMALLEST_AREA)[:, None], np.maximum(last - first + 1, 0), 0)
    count = sides.prod(1)
    rows = np.repeat(np.arange(len(corners)), count)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
    pixels = first[rows] + np.column_stack([within % sides[rows, 0], within // sides[rows, 0]])

    a, b, c = np.moveaxis(places[rows], 1, 0)
    parts = np.stack([_cross(b - pixels, c - pixels), _cross(c - pixels, a - pixels)], axis=1)
    parts /= _cross(b - a, c - a)[:, None]
    weights = np.column_stack([parts, 1 - parts.sum(1)])
    depths = (weights * corners[rows][..., 2]).sum(1)
    kept = (weights > 0).all(1) & (depths >= 0)
    rows, weights, depths, pixels = rows[kept], weights[kept], depths[kept], pixels[kept]
    flat = pixels[:, 1] * image_size + pixels[:, 0]
    order = np.lexsort((rows, depths, flat))
    pixel, firsts = np.unique(flat[order], return_index=True)
    nearest = order[firsts]

    shape = (1, image_size, image_size, 1)
    triangles = np.full(image_size**2, -1, np.int64)
    z, barycentric = (np.full((image_size**2, *more), -1, np.float32) for more in ((), (3,)))
    triangles[pixel], z[pixel], barycentric[pixel] = rows[nearest], depths[nearest], weights[nearest]
    tensors = (torch.from_numpy(values) for values in (triangles, z, barycentric))
    return (*(values.view(*shape, *values.shape[1:]) for values in tensors), None)  # type: ignore[return-value]


def _cross(one: FloatArray, other: FloatArray) -> FloatArray:
    """(n,) third coordinate of the cross products of (n, 2 or 3) vectors."""
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


FILES_AND_ROTATIONS: dict[str, dict[str, Any]] = {
    "pytorch3d": {},
    "pytorch3d.io": {"load_obj": load_obj},
    "pytorch3d.transforms": {
        "rotation_6d_to_matrix": rotation_6d_to_matrix,
        "matrix_to_rotation_6d": matrix_to_rotation_6d,
    },
}
"""The part of PyTorch3D's stand-ins that all official code uses."""
OF_MESHES: dict[str, dict[str, Any]] = {
    **FILES_AND_ROTATIONS,
    "pytorch3d.structures": {"Meshes": Mesh},
    "pytorch3d.renderer": {},
    "pytorch3d.renderer.mesh": {"rasterize_meshes": rasterize_meshes},
}
"""Stand-in modules for packages that are not installed, by name."""


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
    nearest = _nearest(vertices, faces, points)
    corners = faces.long()[torch.from_numpy(nearest.triangles)]
    weights = torch.from_numpy(nearest.weights).to(features)
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
    mesh = read_obj(path)
    return mesh.vertices, mesh.faces


def sample_mesh_poisson_disk(
    vertices: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """About ``count`` points on a mesh, no two of them close: (P,) triangles and (P, 3) barycentric coordinates.

    Coordinates have the dtype of the vertices.
    """
    points = poisson_disk(vertices, faces, np.arange(len(faces)), count, 0)
    return points.triangles, points.barycentric.astype(vertices.dtype)


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
OF_BLENDSHAPES: dict[str, dict[str, Any]] = {
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
    "point_cloud_utils": {"sample_mesh_poisson_disk": sample_mesh_poisson_disk, "load_mesh_vf": load_mesh},
    "torch.utils.tensorboard": {"SummaryWriter": Silent},
}
"""Stand-in modules for packages that are not installed, by name."""
