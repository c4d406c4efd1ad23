"""Small networks over points and one condition, as functions of named tensors.

The published networks concatenate each point's inputs with a condition (expression, pose) that is the same for all
points. Here the condition's part of a layer is computed once and added as a bias, which gives the same result with
less work.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from ..ops.planes import ENCODING_SIZE, encode
from .config import GHAConfig
from .driving import POSE_SIZE, Influence

SLOPE = 0.01
"""Slope of the leaky ReLU between layers."""


class Weights(Protocol):
    """Tensors by name: a dict or an `Optimiser`."""

    def __getitem__(self, name: str, /) -> Tensor: ...


@dataclass(frozen=True)
class Mlp:
    """An MLP with an input skip connection at layer ``len(widths) // 2``, concatenated after the hidden values."""

    name: str
    """Prefix of its tensors, ``NAME.weight_K`` (out, in) and ``NAME.bias_K`` (out,)."""
    point_inputs: int
    condition_inputs: int
    """Sizes of the two parts of the input, in this order."""
    hidden: tuple[int, ...]
    outputs: int
    """Widths of the layers."""
    zero_condition_weights: bool = False
    """Whether the condition's weights are initially zero. Conditions that do not occur in training then have no effect, instead
    of a random one."""
    zero_initialised: bool = False
    """Whether the last layer is initially zero."""

    @property
    def widths(self) -> tuple[int, ...]:
        """Width of the input and of each layer's output, as published."""
        return (self.point_inputs + self.condition_inputs, *self.hidden, self.outputs)

    @property
    def _skip_layer(self) -> int:
        """Index of the layer with the input skip connection; 0 for a single layer."""
        return len(self.widths) // 2 if self.hidden else 0

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of every tensor, by name."""
        widths = self.widths
        shapes: dict[str, tuple[int, ...]] = {}
        for layer in range(len(widths) - 1):
            extra = widths[0] if layer and layer == self._skip_layer else 0
            shapes[f"{self.name}.weight_{layer}"] = (widths[layer + 1], widths[layer] + extra)
            shapes[f"{self.name}.bias_{layer}"] = (widths[layer + 1],)
        return shapes

    def initial(self, generator: torch.Generator, device: str = "cpu") -> dict[str, Tensor]:
        """Weights and biases uniform within 1 / sqrt(inputs) of a layer."""
        tensors = uniform(self.shapes(), generator, device)
        if self.zero_condition_weights and self.condition_inputs:
            for layer in {0, self._skip_layer}:
                tensors[f"{self.name}.weight_{layer}"][:, -self.condition_inputs :] = 0
        if self.zero_initialised:
            for part in ("weight", "bias"):
                tensors[f"{self.name}.{part}_{len(self.hidden)}"].zero_()
        return tensors

    def __call__(
        self, weights: Weights, points: Tensor, condition: Tensor | None = None, outputs: int | None = None
    ) -> Tensor:
        """(N, outputs) of (N, point_inputs) and (condition_inputs,); (B, N, outputs) for (B, condition_inputs).

        ``outputs`` limits the result to the first outputs.
        """

        count, size = len(self.widths) - 1, self.point_inputs
        values = points
        for layer in range(count):
            weight, bias = weights[f"{self.name}.weight_{layer}"], weights[f"{self.name}.bias_{layer}"]
            if layer == count - 1 and outputs is not None:
                weight, bias = weight[:outputs], bias[:outputs]
            again = layer > 0 and layer == self._skip_layer
            if layer == 0 or again:
                start = self.widths[layer] if again else 0
                if condition is not None:
                    bias = F.linear(condition, weight[:, start + size :], bias).unsqueeze(-2)
                if again:
                    bias = F.linear(values, weight[:, :start]) + bias
                by_points = weight[:, start : start + size].t()
                values = torch.addmm(bias, points, by_points) if bias.ndim < 3 else points @ by_points + bias
            else:
                values = F.linear(values, weight, bias)
            if layer < count - 1:
                values = F.leaky_relu(values, SLOPE)
        return values


def uniform(
    shapes: Mapping[str, Sequence[int]], generator: torch.Generator, device: str
) -> dict[str, Tensor]:
    """Tensors uniform within 1 / sqrt(fan-in); a bias has the fan-in of the weight before it."""
    tensors, bound = {}, 0.0
    for name, shape in shapes.items():
        if len(shape) > 1:
            bound = math.prod(shape[1:]) ** -0.5
        values = (2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1) * bound
        tensors[name] = values.to(device, torch.float32)
    return tensors


ATTRIBUTES = (3, 4, 1)
"""Columns of log-scale, quaternion and opacity logit."""

Influences = tuple[Influence, Influence]


@dataclass(frozen=True)
class Controllers:
    """The six networks.

    ``expression`` is the (E,) expression code throughout, ``pose`` the (54,) encoded head pose (`encode_pose`).
    """

    expression_color: Mlp
    pose_color: Mlp
    expression_deform: Mlp
    pose_deform: Mlp
    expression_attribute: Mlp
    pose_attribute: Mlp

    @classmethod
    def of(cls, config: GHAConfig, expression_size: int) -> Controllers:
        """Networks of the configured widths for E driving values."""
        pose = encoded_size(POSE_SIZE)

        def pair(kind: str, inputs: int, outputs: int) -> Iterator[Mlp]:
            starts = (config.zero_initialised, config.zero_initialised and kind != "color")
            for name, size in ((f"expression_{kind}", expression_size), (f"pose_{kind}", pose)):
                yield Mlp(name, inputs, size, getattr(config, f"{name}_hidden"), outputs, *starts)

        return cls(
            *pair("color", config.features, config.channels),
            *pair("deform", ENCODING_SIZE, 3),
            *pair("attribute", config.features, sum(ATTRIBUTES)),
        )

    @property
    def of_mesh(self) -> tuple[Mlp, ...]:
        """The networks trained in the mesh phase."""
        return self.expression_color, self.pose_color, self.expression_deform, self.pose_deform

    @property
    def of_gaussians(self) -> tuple[Mlp, ...]:
        """All networks."""
        return *self.of_mesh, self.expression_attribute, self.pose_attribute

    def colors(
        self,
        weights: Weights,
        features: Tensor,
        influences: Influences,
        expression: Tensor,
        pose: Tensor,
        channels: int | None = None,
    ) -> Tensor:
        """(N, C) of (N, F) features within (-1, 1), without activation; the first ``channels`` if given."""
        networks = (self.expression_color, self.pose_color)
        return blended(networks, weights, features, influences, (expression, pose), channels=channels)

    def attributes(
        self, weights: Weights, features: Tensor, influences: Influences, expression: Tensor, pose: Tensor
    ) -> Tensor:
        """(N, 8) offsets of `ATTRIBUTES`, before their common factor."""
        networks = (self.expression_attribute, self.pose_attribute)
        return blended(networks, weights, features, influences, (expression, pose))

    def displacements(
        self, weights: Weights, encoded: Tensor, influences: Influences, expression: Tensor, pose: Tensor
    ) -> Tensor:
        """(N, 3) displacements of points, whose (N, 27) encoding is given, each within (-1, 1), before their factor."""
        networks = (self.expression_deform, self.pose_deform)
        return blended(networks, weights, encoded, influences, (expression, pose), tanh_output=True)


def encoded_size(size: int) -> int:
    """Size of the encoding of ``size`` values."""
    return size * ENCODING_SIZE // 3


def encode_pose(code: Tensor) -> Tensor:
    """(54,) of the (6,) code of a head pose."""
    return encode(code[None])[0]


def blended(
    networks: tuple[Mlp, Mlp],
    weights: Weights,
    inputs: Tensor,
    influences: Influences,
    conditions: tuple[Tensor, Tensor],
    *,
    tanh_output: bool = False,
    channels: int | None = None,
) -> Tensor:
    """(N, C) sum of two networks' outputs, with tanh if ``tanh_output``, at (N, F) inputs."""
    parts = [
        network(weights, inputs.index_select(0, part.rows), condition, channels)
        for network, part, condition in zip(networks, influences, conditions)
    ]
    total = parts[0].new_zeros(len(inputs), parts[0].shape[1])
    for part, values in zip(influences, parts):
        values = torch.tanh(values) if tanh_output else values
        total = total.index_add(0, part.rows, part.weights[:, None] * values)
    return total
