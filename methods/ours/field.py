"""Attributes of a splat that an expression changes: opacity as published, or others for the ablation.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations" (CVPR 2025,
arXiv 2504.14967), section 3.3 and Table 4: offsets on position, rotation and scale improve novel views and degrade
novel expressions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ..ops.mesh import TriangleFrames, turns_between
from ..ops.planes import (
    AXES,
    ENCODING_SIZE,
    PAIRS,
    Bounds,
    ColorNetwork,
    OffsetLayers,
    triplane_features,
)
from ..ops.splats import points_on
from .config import Dynamic, OursConfig

WIDTHS: Mapping[Dynamic, int] = {"opacity": 1, "position": 3, "rotation": 4, "scale": 3, "color": 3}
"""Number of values per splat of each attribute that may change."""

PLANES = tuple(f"plane_{pair}" for pair, _, _ in PAIRS)
FIRST_LAYER = "color_weight_0"
LAST_LAYER = "color_weight_1"
COLOR_NETWORK = (*PLANES, FIRST_LAYER, LAST_LAYER)
"""Colour as a function of position and direction: planes and the weights of both layers."""

FIELDS = {"opacity": "logits", "position": "means", "rotation": "quats", "scale": "log_scales"}
"""Attributes of `LocalSplats` that offsets are added to."""


class LocalSplats(NamedTuple):
    """Splats in their triangles' frames, before or after changes by an expression."""

    means: Tensor
    """(N, 3) in units of the triangle's size."""
    log_scales: Tensor
    """(N, 3) logarithms in the same unit."""
    quats: Tensor
    """(N, 4), real part first, of any length."""
    logits: Tensor
    """(N,) logits of the opacities."""
    color_change: Tensor | None = None
    """(N, 3) added to the colours before they are clamped at 0; None for no change."""


def offset_width(dynamic: Sequence[Dynamic]) -> int:
    """Outputs of the offset network."""
    return sum(WIDTHS[name] for name in dynamic)


def apply_offsets(splats: LocalSplats, offsets: Tensor, dynamic: Sequence[Dynamic]) -> LocalSplats:
    """Add (N, `offset_width`) offsets, in the order of ``dynamic``, to logits, local means, quaternions and log-scales."""
    parts = dict(zip(dynamic, offsets.split([WIDTHS[name] for name in dynamic], dim=1)))
    if "opacity" in parts:
        parts["opacity"] = parts["opacity"][:, 0]
    fields = {FIELDS[name]: part for name, part in parts.items() if name != "color"}
    changed = {field: getattr(splats, field) + part for field, part in fields.items()}
    if "color" in parts:
        own = splats.color_change
        changed["color_change"] = parts["color"] if own is None else own + parts["color"]
    return splats._replace(**changed)


def changed_colors(colors: Tensor, splats: LocalSplats) -> Tensor:
    """(N, 3) >= 0."""
    return colors if splats.color_change is None else torch.relu(colors + splats.color_change)


class NamedTensors(Protocol):
    """Tensors by name: an optimiser in training, a dict in an avatar."""

    def __getitem__(self, name: str, /) -> Tensor: ...


def blend_lines(lines: Tensor, expression: Tensor, jaw: Tensor) -> Tensor:
    """Blend once per frame: (2, 3, L, C), expression lines first, then jaw lines.

    - ``lines``: (E + J, 3, L, C).
    - ``expression``, ``jaw``: (E,) coefficients and (J,) weights.
    """
    flat = lines.flatten(1)
    count = len(expression)
    blended = torch.stack([expression @ flat[:count], jaw @ flat[count:]])
    return blended.view(2, *lines.shape[1:])


def offset_layers(parameters: NamedTensors) -> OffsetLayers:
    """The offset network after its first weights, which are part of `line_table`; weight-normalised."""
    return OffsetLayers(
        parameters["line_bias_0"],
        *(normalised_weight(parameters, 1), parameters["line_bias_1"]),
        *(normalised_weight(parameters, 2), parameters["line_bias_2"]),
    )


def line_table(blended: Tensor, first: Tensor) -> Tensor:
    """(3 L, H): contribution of each sample of the (2, 3, L, C) blended lines to the first layer of (H, 6 C) weights.

    The layer's inputs are [e_x e_y e_z j_x j_y j_z], C features of each line.
    """
    kinds, axes, resolution, channels = blended.shape
    weights = first.view(-1, kinds, axes, channels)
    return torch.einsum("kalc,hkac->alh", blended, weights).reshape(axes * resolution, -1)


def normalised_weight(parameters: NamedTensors, layer: int) -> Tensor:
    """Weight of a layer: gain times direction, normalised per output row (Salimans and Kingma 2016, eq. 2)."""
    direction, gain = parameters[f"line_direction_{layer}"], parameters[f"line_gain_{layer}"]
    return direction * (gain / torch.linalg.vector_norm(direction, dim=1, keepdim=True))


def initial_line_network(
    channels: int, hidden: int, outputs: int, generator: torch.Generator
) -> dict[str, Tensor]:
    """Directions, gains and biases of the three layers, uniform within 1 / sqrt(fan-in)."""
    sizes = [2 * AXES * channels, hidden, hidden, outputs]
    network: dict[str, Tensor] = {}
    for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        direction = uniform((fan_out, fan_in), fan_in**-0.5, generator)
        network[f"line_direction_{layer}"] = direction
        network[f"line_gain_{layer}"] = torch.linalg.vector_norm(direction, dim=1, keepdim=True)
        network[f"line_bias_{layer}"] = uniform((fan_out,), fan_in**-0.5, generator)
    return network


def uniform(shape: tuple[int, ...], bound: float, generator: torch.Generator) -> Tensor:
    """Uniform numbers in [-bound, bound]."""
    return (torch.rand(shape, generator=generator) * 2 - 1) * bound


PLANE_MARGIN = 0.005  # metres around the canonical mesh
PLANE_MARGIN_BELOW = 0.025  # additional metres at the bottom, for splats of the neck below the mesh
PAPER_HALF_WIDTH = 0.25  # metres


def plane_box(canonical: Tensor, variant: str) -> Bounds:
    """Bounds of the planes around (V, 3) canonical vertices; ``variant`` is ``planes.bounds_variant``."""
    low = canonical.amin(0) - PLANE_MARGIN
    high = canonical.amax(0) + PLANE_MARGIN
    low[1] -= PLANE_MARGIN_BELOW
    if variant == "paper":
        low[0], high[0] = -PAPER_HALF_WIDTH, PAPER_HALF_WIDTH
    return Bounds(low, high)


def line_box(vertices: Tensor) -> Bounds:
    """Bounds of the lines: the box of the given vertices."""
    return Bounds(vertices.amin(0), vertices.amax(0))


@dataclass(frozen=True, eq=False)
class CanonicalFrames:
    """Triangle frames of the canonical mesh, which map splats and directions to canonical space."""

    linear: Tensor
    """(F, 9) size times rotation."""
    center: Tensor
    """(F, 3)."""
    rotation: Tensor
    """(F, 3, 3)."""

    @classmethod
    def of(cls, frames: TriangleFrames) -> CanonicalFrames:
        """Select what is needed from triangle frames."""
        linear = (frames.size[:, None, None] * frames.rotation).flatten(1)
        return cls(linear, frames.center, frames.rotation)

    def positions(self, binding: Tensor, means: Tensor) -> Tensor:
        """Canonical positions (N, 3) of local means: k_c R_c mean + T_c."""
        return points_on(means, binding, self.linear, self.center)

    def turns(self, frames: TriangleFrames) -> Tensor:
        """(F, 3, 3) rotations from world directions of a posed mesh to canonical ones: R_c R_t^T."""
        return turns_between(self.rotation, frames.rotation)


def color_network(parameters: NamedTensors) -> ColorNetwork:
    """The tensors that give colours by position and direction."""
    return ColorNetwork(*(parameters[name] for name in COLOR_NETWORK))


def plane_features(parameters: NamedTensors, box: Bounds, positions: Tensor) -> tuple[Tensor, ...]:
    """Features (N, C_k) of the three planes at canonical positions."""
    return triplane_features([parameters[name] for name in PLANES], box, positions)


def position_part(parameters: NamedTensors, features: tuple[Tensor, ...]) -> Tensor:
    """(N, H) contribution of plane features, (N, C_k) each, to the hidden layer; constant for an avatar."""
    joined = torch.cat(features, dim=1)
    return joined @ parameters[FIRST_LAYER][:, : joined.shape[1]].t()


def initial_parameters(
    config: OursConfig, expressions: int, jaw_bases: int, generator: torch.Generator
) -> dict[str, tuple[Tensor, float]]:
    """Planes U(-0.1, 0.1), networks uniform within 1 / sqrt(fan-in), lines 0; each with its learning rate."""
    result: dict[str, tuple[Tensor, float]] = {}
    if config.color == "planes":
        result |= _initial_planes(config, generator)
    if config.lines.enabled:
        shape = (expressions + jaw_bases, AXES, config.lines.resolution, config.lines.channels)
        result["lines"] = (torch.zeros(shape), config.lines.lr)
        outputs = offset_width(config.lines.dynamic)
        network = initial_line_network(config.lines.channels, config.hidden, outputs, generator)
        result |= {name: (value, config.lines.network_lr) for name, value in network.items()}
    return result


def _initial_planes(config: OursConfig, generator: torch.Generator) -> dict[str, tuple[Tensor, float]]:
    result: dict[str, tuple[Tensor, float]] = {}
    for name, channels in zip(PLANES, config.planes.channels):
        plane = uniform((config.planes.resolution**2, channels), 0.1, generator)
        result[name] = (plane, config.planes.lr)
    inputs = sum(config.planes.channels) + ENCODING_SIZE
    for name, shape in ((FIRST_LAYER, (config.hidden, inputs)), (LAST_LAYER, (3, config.hidden))):
        weight = uniform(shape, shape[1] ** -0.5, generator)
        result[name] = (weight, config.planes.network_lr)
    return result
