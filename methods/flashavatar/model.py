"""The model of FlashAvatar: splats on a mesh, the network that moves, turns and scales them, and its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import linear, normalize

from ...bench.contracts import HeadAsset
from ...bench.io.arrays import Member
from ...datasets.head.rotations import axis_angle_to_quaternion, quaternion_to_matrix
from ..ops.harmonics import coefficient_count, turned_colors
from ..ops.mesh import TriangleFrames
from ..ops.splats import WorldSplats, apply_matrices, left_products, to_world
from ..shared.avatar_files import settings_of_text, settings_text
from ..shared.networks import input_count, layer_names
from ..shared.subject_mesh import SubjectMesh
from ..shared.surface_points import MeshPoints, SurfacePoints, point_tensors, take_points
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, read_safetensors, write_tensors
from .config import FlashAvatarConfig
from .hyper_gaussians import WIDTHS, check_diagonals, conditional_means, gaussian_shapes

INPUTS = ("expression", "jaw", "eyes", "eyelids")
"""Tracked parameters that the network takes, besides the encoded points."""
OUTPUTS = (*WIDTHS.values(),)
"""Columns of the network's outputs: offset, turn, change of size."""


def positional_encoding(points: Tensor, frequencies: int) -> Tensor:
    """(N, 3 + 6 L): the points, then sine and cosine of 1, 2, 4, ... 2^(L - 1) times their (N, 3) coordinates in metres."""
    factors = 2.0 ** torch.arange(frequencies, device=points.device)
    angles = points[:, None] * factors[:, None].to(points)
    return torch.cat([points, torch.stack([angles.sin(), angles.cos()], dim=2).flatten(1)], dim=1)


def encoding_size(frequencies: int) -> int:
    """Columns of `positional_encoding`."""
    return 3 + 6 * frequencies


def network_sizes(config: FlashAvatarConfig, conditions: int) -> tuple[int, ...]:
    """Inputs, hidden widths and outputs of the network, or its latents, for a number of tracked inputs."""
    inputs = encoding_size(config.frequencies) + conditions
    return (inputs, *config.layers * (config.hidden,), config.hyper_gaussians or sum(OUTPUTS))


def layer_of_points(network: Mapping[str, Tensor], encoded: Tensor) -> Tensor:
    """(N, H) part of the first layer's sums that depends on the encoded points alone: the same in every pose."""
    weights, biases = layer_names(1)
    return linear(encoded, network[weights[0]][:, : encoded.shape[1]], network[biases[0]])


def network_outputs(
    network: Mapping[str, Tensor], of_points: Tensor, inputs: Tensor, config: FlashAvatarConfig
) -> Tensor:
    """(N, 10) in [-1, 1]: the network's outputs at the points, after tanh.

    The inputs of the network are the encoded point and the tracked parameters, one after the other; the first layer is linear, so the
    parts of both are added. With ``hyper_gaussians`` the outputs are conditional means of the splats' Gaussians, also in ``network``.

    Parameters
    ----------
    of_points, inputs : Tensor
        (N, H) from `layer_of_points`, and the (I,) `tracked_inputs` of the pose.
    """
    weights, biases = layer_names(config.layers + 1)
    of_inputs = network[weights[0]][:, encoding_size(config.frequencies) :]
    values = of_points + of_inputs @ inputs
    for weight, bias in zip(weights[1:], biases[1:]):
        values = linear(values.relu(), network[weight], network[bias])
    if config.hyper_gaussians:
        values = conditional_means(network, values)
    return values.tanh()


def changed(
    splats: Mapping[str, Tensor], outputs: Tensor, config: FlashAvatarConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Splats in the axes of the head with the (N, 10) outputs of the network applied.

    Returns (N, 3) offsets from the surface in metres, (N, 3) logarithms of sizes in metres, and (N, 4) quaternions wxyz of any
    length: the splat's own, multiplied from the right by the network's, whose real part is exp(tanh).
    """
    offset, turn, scale = outputs.split(OUTPUTS, dim=1)
    turned = torch.cat([turn[:, :1].exp(), turn[:, 1:]], dim=1)
    quats = apply_matrices(left_products(splats["quats"]).flatten(1), turned)
    sizes = splats["log_scales"]
    log_scales = sizes * scale.exp() if config.scale_variant == "official" else sizes + scale
    return config.offset_m * offset, log_scales, quats


class HeadSurface:
    """Points on the mesh of a subject with the axes of the head at each.

    The authors' program moves the camera around a head without rotation, neck and translation. Here these move the mesh, and the axes
    turn with them: with root and neck as far as the surface follows the neck, by the skinning weights, and with the root
    alone elsewhere. They do not turn with jaw and eyes, whose effect the network learns, as in that program.

    Attributes
    ----------
    rest : Tensor
        (N, 3) points on the neutral mesh, metres.
    """

    def __init__(self, mesh: SubjectMesh, points: SurfacePoints):
        self.mesh, self._at_points = mesh, MeshPoints(points, mesh.faces, mesh.canonical)
        self.rest = self._at_points(mesh.canonical)
        self._of_root = self._at_points(mesh.model.skinning_weights[:, :1])
        self._each = torch.arange(len(self.rest), device=self.rest.device)
        self._unit = torch.ones_like(self._of_root[:, 0])

    @torch.no_grad()
    def posed(self, arguments: Mapping[str, Tensor]) -> TriangleFrames:
        """Axes at the points for the arguments of one timestep, each centred on its point, in metres."""
        root, neck = (axis_angle_to_quaternion(arguments[name]) for name in ("rotation", "neck"))
        head = apply_matrices(left_products(root).flatten(1), neck)
        # The shorter way from one to the other, as the real part of their quotient, the neck's, is not negative.
        turns = normalize(head + self._of_root * (root - head), dim=1)
        points = self._at_points(self.mesh.posed(arguments))
        return TriangleFrames(quaternion_to_matrix(turns), points, self._unit, turns)

    def place(self, frames: TriangleFrames, splats: tuple[Tensor, Tensor, Tensor]) -> WorldSplats:
        """Splats of `changed` in the world."""
        return to_world(frames, self._each, *splats)


def colors_seen(
    splats: Mapping[str, Tensor], world: WorldSplats, frames: TriangleFrames, center: Tensor, degree: int
) -> Tensor:
    """(N, 3) colours seen from a camera at ``center`` (3,); the harmonics turn with the axes of the head."""
    return turned_colors(splats["sh_dc"], splats["sh_rest"], world.means, frames.rotation, center, degree)


SETTINGS_KEY = "settings"
"""Key of the file's metadata: the settings of rendering, as JSON."""
OPTIONAL = ("hyper_gaussians",)
RENDERING = ("frequencies", "layers", "hidden", *OPTIONAL, "offset_m", "scale_variant", "sh_degree")
"""Settings that affect rendering; those in `OPTIONAL` are not stored if they are 0."""
PER_SPLAT = {"log_scales": (3,), "quats": (4,), "opacities": (), "sh_dc": (3,)}
"""Shape of a splat's stored values besides the harmonics above degree 0: logarithms of metres, wxyz, logits."""


class TrainedSplats(NamedTuple):
    """Content of an avatar's file.

    Attributes
    ----------
    tensors : dict[str, Tensor]
        Those of `PER_SPLAT`, ``sh_rest`` (N, 3, K - 1), those of `gaussian_shapes`, and weights and biases of the network.
    points : SurfacePoints
        Surface point of each splat.
    config : FlashAvatarConfig
        With the settings in `RENDERING` that it was trained with.
    """

    tensors: dict[str, Tensor]
    points: SurfacePoints
    config: FlashAvatarConfig

    def checked(self, path: Path, head: HeadAsset, device: str) -> TrainedSplats:
        """The same on a device. Raises `InputError`, naming ``path``, where the tensors do not fit each other or the head."""
        config = self.config
        shapes: dict[str, tuple[int | str, ...]] = {name: ("N", *shape) for name, shape in PER_SPLAT.items()}
        shapes["sh_rest"] = ("N", 3, coefficient_count(config.sh_degree) - 1)
        gaussians = gaussian_shapes(config.hyper_gaussians)
        shapes |= {name: ("N", *shape) for name, shape in gaussians.items()}
        sizes = network_sizes(config, input_count(head, INPUTS))
        for layer, (weight, bias) in enumerate(zip(*layer_names(len(sizes) - 1))):
            shapes |= {weight: (sizes[layer + 1], sizes[layer]), bias: (sizes[layer + 1],)}
        members = {name: Member("f", shape, MAX_MAGNITUDE, "f4") for name, shape in shapes.items()}
        check_tensors(path, self.tensors, members, {"N": len(self.points.triangles)})
        if gaussians:
            check_diagonals(path, self.tensors)
        check_sizes(path, math.e * self.tensors["log_scales"])  # the largest that the network makes of them
        return self._replace(tensors={name: self.tensors[name].to(device) for name in shapes})


def rendering_text(config: FlashAvatarConfig) -> str:
    """The settings that affect rendering, as JSON."""
    return settings_text(config, RENDERING, OPTIONAL)


def rendering_of_text(path: Path, text: str) -> FlashAvatarConfig:
    """Settings with those of a `rendering_text`. Raises `InputError`, naming ``path``, for other text."""
    return settings_of_text(FlashAvatarConfig, RENDERING, text, path, SETTINGS_KEY, OPTIONAL)


def write_avatar(path: Path, trained: TrainedSplats) -> None:
    """Write an avatar as safetensors, exact: 56 bytes for each splat, 12 for each of its harmonics above degree 0, with
    ``hyper_gaussians`` of L another 128 + 52 L, and the network."""
    tensors = trained.tensors | point_tensors(trained.points)
    write_tensors(path, tensors, {SETTINGS_KEY: rendering_text(trained.config)})


def read_avatar(path: Path, head: HeadAsset, device: str) -> TrainedSplats:
    """Read and check what `write_avatar` wrote. Raises `InputError` where a tensor is missing or does not fit."""
    tensors, metadata = read_safetensors(path)
    config = rendering_of_text(path, metadata.get(SETTINGS_KEY, ""))
    points = take_points(path, tensors, len(head.faces))
    return TrainedSplats(tensors, points, config).checked(path, head, device)
