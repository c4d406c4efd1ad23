"""Stand-ins for PyTorch3D: rotations as six numbers, OBJ files, and the rasterisation of a mesh such as a texture chart."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import FloatArray, IntArray

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
    found = read_obj(path)
    uv = torch.from_numpy(found.uv).float() if len(found.uv) else None
    faces = Faces(torch.from_numpy(found.faces), torch.from_numpy(found.uv_faces))
    return torch.from_numpy(found.vertices).float(), faces, Auxiliary(uv)


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
PACKAGES: dict[str, dict[str, Any]] = {
    **FILES_AND_ROTATIONS,
    "pytorch3d.structures": {"Meshes": Mesh},
    "pytorch3d.renderer": {},
    "pytorch3d.renderer.mesh": {"rasterize_meshes": rasterize_meshes},
}
"""Stand-in modules for packages that are not installed, by name."""
