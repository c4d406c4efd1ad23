"""One-dimensional feature lines blended by expression and jaw, and the small network behind them.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations", section 3.3.
The first layer is linear, and so is interpolation; hence it is applied to the few samples of the blended lines
and not to every splat. The result is the same up to rounding, at a hundredth of the cost.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ..shared.networks import offset_network
from ..shared.row_sums import sum_rows

AXES = 3


class Parameters(Protocol):
    """Tensors by name: an optimiser in training, a dict in an avatar."""

    def __getitem__(self, name: str, /) -> Tensor: ...


class LinePosition(NamedTuple):
    """Where points lie on the three lines: rows of the (3 L)-row table and linear weights, (N, 6) each."""

    rows: Tensor
    weights: Tensor


def line_position(points: Tensor, resolution: int) -> LinePosition:
    """Positions of (N, 3) points in [0, 1] on lines of ``resolution`` samples: sample ``t (L - 1)``."""
    position = (points * (resolution - 1)).clamp(0, resolution - 1)
    lower = position.floor().clamp_max(resolution - 2)
    fraction = position - lower
    start = torch.arange(AXES, device=points.device) * resolution
    rows = lower.to(torch.int64) + start
    return LinePosition(
        torch.cat([rows, rows + 1], dim=1), torch.cat([1 - fraction, fraction], dim=1).to(points.dtype)
    )


def blend_lines(lines: Tensor, expression: Tensor, jaw: Tensor) -> Tensor:
    """Blend once per frame: (2, 3, L, C), expression lines first, then jaw lines.

    Parameters
    ----------
    lines : (E + J, 3, L, C).
    expression, jaw : (E,) coefficients and (J,) weights.
    """
    flat = lines.flatten(1)
    count = len(expression)
    blended = torch.stack([expression @ flat[:count], jaw @ flat[count:]])
    return blended.view(2, *lines.shape[1:])


def line_offsets(parameters: Parameters, blended: Tensor, position: LinePosition) -> Tensor:
    """(N, D) offsets: 6 C features -> hidden -> hidden -> D, ReLU, weight-normalised; D = 1 is the opacity logit.

    The features are [e_x e_y e_z j_x j_y j_z]; none of the inputs but the lines and the network has a gradient.
    """
    table = line_table(blended, normalised_weight(parameters, 0))
    return offset_network(
        sum_rows(table, *position),
        *(parameters["line_bias_0"],),
        *(normalised_weight(parameters, 1), parameters["line_bias_1"]),
        *(normalised_weight(parameters, 2), parameters["line_bias_2"]),
    )


def line_table(blended: Tensor, first: Tensor) -> Tensor:
    """(3 L, H): what each sample of the (2, 3, L, C) blended lines adds to the first layer of (H, 6 C) weights."""
    kinds, axes, resolution, channels = blended.shape
    weights = first.view(-1, kinds, axes, channels)
    return torch.einsum("kalc,hkac->alh", blended, weights).reshape(axes * resolution, -1)


def normalised_weight(parameters: Parameters, layer: int) -> Tensor:
    """Weight of a layer: gain times direction, normalised per output row (Salimans and Kingma 2016, eq. 2)."""
    direction = parameters[f"line_direction_{layer}"]
    return direction * (
        parameters[f"line_gain_{layer}"] / torch.linalg.vector_norm(direction, dim=1, keepdim=True)
    )


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
