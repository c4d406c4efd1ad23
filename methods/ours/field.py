"""Attributes of a splat that an expression changes, opacity as published or others for the ablation, and the avatar's file.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations" (CVPR 2025,
arXiv 2504.14967), section 3.3 and Table 4: offsets on position, rotation and scale improve novel views and degrade
novel expressions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, Protocol, cast

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import HeadAsset
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ..ops.planes import (
    AXES,
    ENCODING_SIZE,
    PAIRS,
    Bounds,
    ColorNetwork,
    OffsetLayers,
    coefficient_count,
    triplane_features,
)
from ..ops.splats import TriangleFrames, points_on, turns_between
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, read_safetensors, write_tensors
from .spec import Dynamic, OursConfig

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


def blend_lines(lines: Tensor, coefficients: Tensor) -> Tensor:
    """Blend once per frame: (2, 3, L, C), expression lines first, then jaw lines.

    - ``lines``: (E + J, 3, L, C).
    - ``coefficients``: (2, E + J), see `appearance.driving_coefficients`.
    """
    return (coefficients @ lines.flatten(1)).view(2, *lines.shape[1:])


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
    weights = first.view(-1, kinds * axes, channels).permute(1, 2, 0)
    return torch.bmm(blended.flatten(0, 1), weights).view(kinds, axes * resolution, -1).sum(0)


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


FIELD_FILE = "avatar.safetensors"
DYNAMIC = "dynamic"
"""Key of the file's metadata: attributes that the lines change, in the order of the offset network's outputs."""
RESIDUAL = "color_residual"
"""The (N, 3) separate colours of splats, added to those of the planes."""
PER_SPLAT = ("splats", "sh_dc", "sh_rest", RESIDUAL)
"""Tensors with a row for each splat."""
SPLAT_WIDTHS = {"means": 3, "opacities": 1, "log_scales": 3, "quats": 4, "binding": 1}
"""Columns of the (N, 12) float32 splat table, 48 bytes each; the triangle is exact up to 2^24."""


def splat_columns(table: Tensor) -> dict[str, Tensor]:
    """The (N, width) columns of a splat table by name."""
    return dict(zip(SPLAT_WIDTHS, table.split(list(SPLAT_WIDTHS.values()), dim=1)))


def write_field(
    path: Path,
    splats: Mapping[str, Tensor],
    binding: Tensor,
    shared: Mapping[str, Tensor],
    plane_box: Bounds,
    line_box: Bounds,
    jaw_bases: np.ndarray,
    dynamic: Sequence[Dynamic],
) -> None:
    """Write splats, planes, lines, networks, boxes and jaw bases as float32 safetensors."""
    columns = {**splats, "opacities": splats["opacities"][:, None], "binding": binding[:, None]}
    tensors = dict(shared) | {name: splats[name] for name in PER_SPLAT if name in splats}
    tensors |= {
        "splats": torch.cat([columns[name] for name in SPLAT_WIDTHS], dim=1),
        "plane_box": torch.stack(list(plane_box)),
        "line_box": torch.stack(list(line_box)),
        "jaw_bases": torch.tensor(np.asarray(jaw_bases, dtype=np.float32)),
    }
    save_field(path, StoredField(tensors, tuple(dynamic)))


class StoredField(NamedTuple):
    """Content of an avatar's file: its tensors by name, and the attributes that the lines change."""

    tensors: dict[str, Tensor]
    dynamic: tuple[Dynamic, ...]


def save_field(path: Path, field: StoredField) -> None:
    """Write the exact file of a field atomically."""
    write_tensors(path, field.tensors, {DYNAMIC: ",".join(field.dynamic)})


def read_field(path: Path, head: HeadAsset, device: str) -> StoredField:
    """Read and check what `save_field` wrote."""
    return field_of(path, *read_safetensors(path), head, device)


def field_of(
    path: Path, tensors: dict[str, Tensor], metadata: Mapping[str, str], head: HeadAsset, device: str
) -> StoredField:
    """Check the tensors and metadata of a file."""
    names = metadata.get(DYNAMIC, "opacity")
    given = names.split(",")
    if len(set(given)) != len(given) or not set(given) <= set(WIDTHS):
        raise InputError(path, DYNAMIC, f"names among {', '.join(WIDTHS)}, each once", repr(names)[:80])
    dynamic = cast(tuple[Dynamic, ...], tuple(given))
    needed = ["splats", "plane_box", "line_box", "jaw_bases"]
    if "sh_dc" in tensors:
        needed += ["sh_rest"]
    else:
        needed += COLOR_NETWORK
    if "lines" in tensors:
        needed += [f"line_{part}_{layer}" for layer in range(3) for part in ("direction", "gain", "bias")]
    number = Member("f", None, MAX_MAGNITUDE, "f4")
    check_tensors(path, tensors, dict.fromkeys([*needed, *tensors], number))
    _check_shapes(path, tensors, head, offset_width(dynamic))
    return StoredField({name: value.to(device) for name, value in tensors.items()}, dynamic)


def _check_shapes(path: Path, tensors: Mapping[str, Tensor], head: HeadAsset, outputs: int) -> None:
    """Raise `InputError` for the first tensor inconsistent with the others, so that rendering cannot fail."""

    def require(name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise InputError(path, name, expected, f"shape {tuple(tensors[name].shape)}")

    def exactly(name: str, *shape: int) -> None:
        require(name, tensors[name].shape == shape, f"shape {shape}")

    face_count, expression_size = len(head.faces), head.expression_basis.shape[2]
    splats = tensors["splats"]
    width = sum(SPLAT_WIDTHS.values())
    require("splats", splats.ndim == 2 and splats.shape[1] == width, f"(N, {width})")
    binding = splats[:, -1]
    if len(binding) and not (0 <= float(binding.min()) and float(binding.max()) < face_count):
        found = f"{float(binding.min()):g} to {float(binding.max()):g}"
        raise InputError(path, "splats, triangle", f"0 to {face_count - 1}", found)
    check_sizes(path, splat_columns(splats)["log_scales"])
    for name in ("plane_box", "line_box"):
        exactly(name, 2, 3)
        if not (tensors[name][0] < tensors[name][1]).all():
            raise InputError(path, name, "a low corner below the high corner", str(tensors[name].tolist()))

    if "sh_dc" in tensors:
        exactly("sh_dc", len(splats), 3)
        rest = tensors["sh_rest"]
        counts = [coefficient_count(degree) - 1 for degree in range(4)]
        fits = rest.shape[:2] == (len(splats), 3) and rest.ndim == 3 and rest.shape[2] in counts
        require("sh_rest", fits, f"({len(splats)}, 3, K), K one of {counts}")
    else:
        if RESIDUAL in tensors:
            exactly(RESIDUAL, len(splats), 3)
        for name in PLANES:
            plane = tensors[name]
            square = plane.ndim == 2 and round(len(plane) ** 0.5) ** 2 == len(plane) >= 4
            alike = square and len(plane) == len(tensors[PLANES[0]])
            require(name, alike, "(R * R, C), R of all planes equal")
        inputs = sum(tensors[name].shape[1] for name in PLANES) + ENCODING_SIZE
        first = tensors[FIRST_LAYER]
        require(FIRST_LAYER, first.ndim == 2 and first.shape[1] == inputs, f"(H, {inputs})")
        exactly(LAST_LAYER, 3, len(first))

    bases = tensors["jaw_bases"]
    require("jaw_bases", bases.ndim == 2 and bases.shape[1] == 4, "(J, 4)")
    if "lines" not in tensors:
        return
    lines, jaws = tensors["lines"], len(bases)
    fits = lines.ndim == 4 and lines.shape[1] == 3 and jaws <= len(lines) <= jaws + expression_size
    expected = f"(E + {jaws}, 3, L, C), E at most {expression_size}, L > 1"
    require("lines", fits and lines.shape[2] >= 2, expected)
    sizes = [6 * lines.shape[3], *(len(tensors[f"line_bias_{layer}"]) for layer in (0, 1)), outputs]
    for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        exactly(f"line_direction_{layer}", fan_out, fan_in)
        exactly(f"line_gain_{layer}", fan_out, 1)
        exactly(f"line_bias_{layer}", fan_out)
