"""The model of RGBAvatar: splats on a mesh, blendshapes of them, the network of their weights, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import linear

from ...bench.contracts import HeadAsset
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ..ops.harmonics import C0
from ..ops.mesh import TriangleFrames
from ..ops.splats import WorldSplats, to_world
from ..shared.networks import input_count, layer_names
from ..shared.subject_mesh import SubjectMesh
from ..shared.surface_points import MeshPoints, SurfacePoints, point_tensors, take_points
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, read_safetensors, write_tensors
from .config import INPUTS

INPUTS_KEY = "inputs"
"""Key of the file's metadata: the network's inputs."""
SHAPES = {"means": "mean_shapes", "quats": "quat_shapes", "colors": "color_shapes"}
"""Attributes that blendshapes change, and the names of their blendshapes."""
WEIGHTS, BIASES = layer_names(3)
_SPLATS: dict[str, tuple[int | str, ...]] = {
    "means": ("N", 3),
    "quats": ("N", 4),
    "colors": ("N", 3),
    "log_scales": ("N", 3),
    "opacities": ("N",),
    "mean_shapes": ("K", "N", 3),
    "quat_shapes": ("K", "N", 4),
    "color_shapes": ("K", "N", 3),
    **dict(zip(WEIGHTS, (("hidden", "inputs"), ("hidden 2", "hidden"), ("K", "hidden 2")))),
    **dict(zip(BIASES, (("hidden",), ("hidden 2",), ("K",)))),
}
MEMBERS = {name: Member("f", shape, MAX_MAGNITUDE, "f4") for name, shape in _SPLATS.items()}
"""Tensors of an avatar of N splats and K blendshapes, beside its `POINT_MEMBERS`. Positions are in metres along the axes of the
triangle, quaternions wxyz, colours harmonics of degree 0, scales logarithms of metres, opacities logits; weights and biases of the
network."""


def blend_weights(network: Mapping[str, Tensor], inputs: Tensor) -> Tensor:
    """(T, K) weights of the blendshapes for (T, I) inputs; three layers with ReLU between them."""
    values = inputs
    for layer, (weight, bias) in enumerate(zip(WEIGHTS, BIASES)):
        values = linear(values.relu() if layer else values, network[weight], network[bias])
    return values


def blended(splats: Mapping[str, Tensor], weights: Tensor) -> list[dict[str, Tensor]]:
    """Splats of each of T poses: the neutral ones plus the blendshapes times the (T, K) weights."""
    posed: list[dict[str, Tensor]] = [dict(splats) for _ in range(len(weights))]
    for name, shapes_name in SHAPES.items():
        shapes = splats[shapes_name]
        changes = (weights @ shapes.flatten(1)).view(-1, *shapes.shape[1:])
        for splat, change in zip(posed, changes):
            splat[name] = splat[name] + change
    return posed


class PointsOfPose(NamedTuple):
    """Surface of a pose: the triangles' axes, of size 1 and without position, and the (N, 3) points of the splats."""

    axes: TriangleFrames
    points: Tensor


class Surface:
    """The surface points that splats are bound to, on the mesh of a subject."""

    def __init__(self, mesh: SubjectMesh, points: SurfacePoints):
        self.mesh, self._at_points = mesh, MeshPoints(points, mesh.faces, mesh.canonical)

    @torch.no_grad()
    def posed(self, arguments: Mapping[str, Tensor]) -> PointsOfPose:
        """The surface for the arguments of one timestep."""
        vertices = self.mesh.posed(arguments)
        frames = self.mesh.frames(vertices)
        axes = frames._replace(center=torch.zeros_like(frames.center), size=torch.ones_like(frames.size))
        return PointsOfPose(axes, self._at_points(vertices))

    def place(self, surface: PointsOfPose, splats: Mapping[str, Tensor]) -> WorldSplats:
        """Splats in the world: turned with their triangle, moved with their surface point, of unchanged size."""
        means, log_scales, quats = (splats[name] for name in ("means", "log_scales", "quats"))
        world = to_world(surface.axes, self._at_points.triangles, means, log_scales, quats)
        return world._replace(means=world.means + surface.points)


def seen_colors(values: Tensor) -> Tensor:
    """(N, 3) colours of harmonics of degree 0, from every direction."""
    return (0.5 + C0 * values).relu()


class StoredShapes(NamedTuple):
    """Content of an avatar's file.

    Attributes
    ----------
    tensors : dict[str, Tensor]
        By the names of `MEMBERS`.
    points : SurfacePoints
        Surface point of each splat.
    inputs : tuple[str, ...]
        Tracked parameters that the network takes.
    """

    tensors: dict[str, Tensor]
    points: SurfacePoints
    inputs: tuple[str, ...]

    def checked(self, path: Path, head: HeadAsset, device: str) -> StoredShapes:
        """The same on a device. Raises `InputError`, naming ``path``, where the tensors do not fit each other or the head."""
        sizes = {"inputs": input_count(head, self.inputs), "N": len(self.points.triangles)}
        check_tensors(path, self.tensors, MEMBERS, sizes)
        check_sizes(path, self.tensors["log_scales"])
        return self._replace(tensors={name: self.tensors[name].to(device) for name in MEMBERS})


def write_avatar(path: Path, stored: StoredShapes) -> None:
    """Write an avatar as safetensors, exact: 68 bytes for each splat and 40 for each of its blendshapes."""
    tensors = stored.tensors | point_tensors(stored.points)
    write_tensors(path, tensors, {INPUTS_KEY: ",".join(stored.inputs)})


def read_avatar(path: Path, head: HeadAsset, device: str) -> StoredShapes:
    """Read and check what `write_avatar` wrote. Raises `InputError` where a tensor is missing or does not fit."""
    tensors, metadata = read_safetensors(path)
    inputs = input_names(path, metadata.get(INPUTS_KEY, ""))
    points = take_points(path, tensors, len(head.faces))
    return StoredShapes(tensors, points, inputs).checked(path, head, device)


def input_names(path: Path, names: str) -> tuple[str, ...]:
    """The names of a comma-separated list. Raises `InputError`, naming ``path``, for others than `INPUTS`."""
    inputs = tuple(names.split(","))
    if not set(inputs) <= set(INPUTS) or len(set(inputs)) != len(inputs):
        raise InputError(path, INPUTS_KEY, f"names among {', '.join(INPUTS)}, each once", repr(names)[:80])
    return inputs
