"""The tensorial appearance of "ours" as functions of canonical position: colour and opacity offset.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations" (CVPR 2025,
arXiv 2504.14967), sections 3.2 and 3.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..shared.binding import Frames, apply_matrices
from ..shared.networks import color_network
from ..shared.sh import C0
from ..shared.triplane import ENCODING_SIZE, PAIRS, encode_directions, sample_triplane
from .config import OursConfig
from .dynamics import offset_width
from .feature_lines import AXES, Parameters, initial_line_network, uniform

PLANE_MARGIN = 0.005  # metres around the canonical mesh
PLANE_MARGIN_BELOW = 0.025  # metres more at the bottom: splats of the neck hang below the mesh
PUBLISHED_HALF_WIDTH = 0.25  # metres


class Box(NamedTuple):
    """Axis-aligned box: (3,) corners, metres."""

    low: Tensor
    high: Tensor

    def unit(self, points: Tensor) -> Tensor:
        """Map the box to [0, 1]."""
        return (points - self.low) / (self.high - self.low)

    def contains(self, points: Tensor) -> Tensor:
        """(N,) whether points lie in the box, its faces included."""
        return ((points >= self.low) & (points <= self.high)).all(1)


def plane_box(canonical: Tensor, bounds: str) -> Box:
    """Bounds of the planes around (V, 3) canonical vertices; ``bounds`` as in `OursConfig`."""
    low = canonical.amin(0) - PLANE_MARGIN
    high = canonical.amax(0) + PLANE_MARGIN
    low[1] -= PLANE_MARGIN_BELOW
    if bounds == "published":
        low[0], high[0] = -PUBLISHED_HALF_WIDTH, PUBLISHED_HALF_WIDTH
    return Box(low, high)


def line_box(vertices: Tensor) -> Box:
    """Bounds of the lines: exactly the vertices given."""
    return Box(vertices.amin(0), vertices.amax(0))


@dataclass(frozen=True, eq=False)
class CanonicalFrames:
    """Triangle frames of the canonical mesh, and the way of splats and directions into it.

    Attributes
    ----------
    linear : (F, 9) size times rotation.
    center : (F, 3).
    rotation : (F, 3, 3).
    """

    linear: Tensor
    center: Tensor
    rotation: Tensor

    @classmethod
    def of(cls, frames: Frames) -> CanonicalFrames:
        """Take what is needed from triangle frames."""
        linear = (frames.size[:, None, None] * frames.rotation).flatten(1)
        return cls(linear, frames.center, frames.rotation)

    def positions(self, binding: Tensor, means: Tensor) -> Tensor:
        """Canonical positions (N, 3) of local means: k_c R_c mean + T_c."""
        linear = self.linear.index_select(0, binding)
        return apply_matrices(linear, means) + self.center.index_select(0, binding)

    def turns(self, frames: Frames) -> Tensor:
        """(F, 3, 3) rotations that take world directions of a posed mesh to canonical ones: R_c R_t^T."""
        return self.rotation @ frames.rotation.transpose(1, 2)


def canonical_directions(turns: Tensor, binding: Tensor, means: Tensor, center: Tensor) -> Tensor:
    """Unit vectors (N, 3) from world means to the camera, turned to canonical space by each splat's triangle."""
    directions = torch.nn.functional.normalize(center - means, dim=1)
    rows = turns.reshape(-1, 9).index_select(0, binding)
    return torch.nn.functional.normalize(apply_matrices(rows, directions), dim=1)


def plane_features(parameters: Parameters, box: Box, positions: Tensor) -> tuple[Tensor, ...]:
    """Features (N, C_k) of the three planes at canonical positions."""
    planes = {name: parameters[f"plane_{name}"] for name, _, _ in PAIRS}
    resolution = round(len(planes["xy"]) ** 0.5)
    return sample_triplane(planes, 2 * box.unit(positions) - 1, resolution)


def shade(parameters: Parameters, features: tuple[Tensor, ...], directions: Tensor) -> Tensor:
    """Colours (N, 3) >= 0 of plane features and canonical directions; the way of training."""
    return color_network(parameters["color_weight_0"], parameters["color_weight_1"], features, directions)


def position_part(parameters: Parameters, features: tuple[Tensor, ...]) -> Tensor:
    """What plane features, (N, C_k) each, add to the hidden layer; for an avatar it never changes."""
    joined = torch.cat(features, dim=1)
    return joined @ parameters["color_weight_0"][:, : joined.shape[1]].t()


def shade_directions(parameters: Parameters, from_position: Tensor, directions: Tensor) -> Tensor:
    """Colours (N, 3) >= 0: hidden layer of position and encoded direction, ReLU, relu(0.5 + C0 * out).

    The same as `shade` up to rounding, where the part of the position is known beforehand.
    """
    first, last = parameters["color_weight_0"], parameters["color_weight_1"]
    of_direction = first[:, first.shape[1] - ENCODING_SIZE :]
    hidden = torch.addmm(from_position, encode_directions(directions), of_direction.t()).relu_()
    return torch.relu(0.5 + C0 * (hidden @ last.t()))


def initial_parameters(
    config: OursConfig, expressions: int, jaw_bases: int, generator: torch.Generator
) -> dict[str, tuple[Tensor, float]]:
    """Planes U(-0.1, 0.1), networks uniform within 1 / sqrt(fan-in), lines 0; each with its learning rate."""
    result: dict[str, tuple[Tensor, float]] = {}
    if config.color == "planes":
        result |= _initial_planes(config, generator)
    if config.lines:
        shape = (expressions + jaw_bases, AXES, config.line_resolution, config.line_channels)
        result["lines"] = (torch.zeros(shape), config.line_lr)
        outputs = offset_width(config.dynamic)
        network = initial_line_network(config.line_channels, config.hidden, outputs, generator)
        result |= {name: (value, config.line_mlp_lr) for name, value in network.items()}
    return result


def _initial_planes(config: OursConfig, generator: torch.Generator) -> dict[str, tuple[Tensor, float]]:
    result: dict[str, tuple[Tensor, float]] = {}
    for (name, _, _), channels in zip(PAIRS, config.plane_channels):
        plane = uniform((config.plane_resolution**2, channels), 0.1, generator)
        result[f"plane_{name}"] = (plane, config.plane_lr)
    inputs = sum(config.plane_channels) + ENCODING_SIZE
    weights = [
        uniform((config.hidden, inputs), inputs**-0.5, generator),
        uniform((3, config.hidden), config.hidden**-0.5, generator),
    ]
    return result | {f"color_weight_{layer}": (w, config.color_mlp_lr) for layer, w in enumerate(weights)}
