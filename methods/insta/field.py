"""The canonical radiance field: hash encoding, density network, colour network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from ..shared.networks import sh_basis
from ..shared.schedule import torch_generator
from .config import InstaConfig
from .hash_grid import INITIAL, Level, encode, make_levels, table_rows
from .networks import initial_weights, layer_shapes, network

SH_DEGREE = 3  # 16 basis functions; the published program calls that degree 4
DIRECTIONS = (SH_DEGREE + 1) ** 2
LOG_DENSITY_MAX = 15.0  # of its gradient, as published; keeps a sample's thickness finite

Parameters = Mapping[str, Tensor]


class Box(NamedTuple):
    """Cube of canonical space that the encoding covers: (3,) lower corner and side, metres."""

    low: Tensor
    side: float

    def normalised(self, positions: Tensor) -> Tensor:
        """Positions in [0, 1]."""
        return ((positions - self.low) / self.side).clamp(0, 1)


class Prior(NamedTuple):
    """What the logarithm of the density is before training: highest at the mesh. See `InstaConfig`."""

    bias: float
    depth: float
    scale: float

    @classmethod
    def of(cls, config: InstaConfig) -> Prior:
        """The prior of a configuration."""
        return cls(config.density_bias, config.prior_depth, config.prior_scale)

    def __call__(self, distances: Tensor) -> Tensor:
        """(N,) at (N,) distances from the mesh, metres."""
        return self.bias - (distances / self.scale).clamp(max=self.depth)


class Architecture(NamedTuple):
    """Sizes of the field."""

    levels: tuple[Level, ...]
    features: int
    density_shapes: list[tuple[int, int]]
    color_shapes: list[tuple[int, int]]
    conditions: int
    latent: int

    @classmethod
    def of(cls, config: InstaConfig, expressions: int) -> Architecture:
        """Sizes that a configuration asks for, with a head of so many expression coefficients."""
        levels = make_levels(
            config.levels, config.base_resolution, config.finest_resolution, config.log2_table
        )
        conditions = min(config.conditions, expressions)
        inputs = config.levels * config.level_features + conditions
        return cls(
            levels,
            config.level_features,
            layer_shapes(inputs, config.hidden, config.density_layers, config.latent),
            layer_shapes(config.latent + DIRECTIONS, config.hidden, config.color_layers, 3),
            conditions,
            config.latent,
        )

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of every parameter by name."""
        named: dict[str, tuple[int, ...]] = {"table": (table_rows(self.levels), self.features)}
        named |= {f"density_{i}": shape for i, shape in enumerate(self.density_shapes)}
        return named | {f"color_{i}": shape for i, shape in enumerate(self.color_shapes)}

    def initial(self, seed: int) -> dict[str, Tensor]:
        """Parameters to start training from."""
        generator = torch_generator(seed, "insta field")
        table = (2 * torch.rand(self.shapes()["table"], generator=generator) - 1) * INITIAL
        density = initial_weights(self.density_shapes, generator)
        color = initial_weights(self.color_shapes, generator)
        named = {"table": table}
        named |= {f"density_{i}": weight for i, weight in enumerate(density)}
        return named | {f"color_{i}": weight for i, weight in enumerate(color)}


class Field:
    """Density and colour at canonical points.

    Parameters
    ----------
    prior : added to the logarithm of the density per metre.
    """

    def __init__(self, architecture: Architecture, box: Box, prior: Prior):
        self.architecture, self.box, self.prior = architecture, box, prior

    def latent(self, parameters: Parameters, positions: Tensor, conditions: Tensor, rows: Tensor) -> Tensor:
        """(N, L) outputs of the density network at (N, 3) positions, metres.

        Parameters
        ----------
        conditions : (M, K) sets of coefficients, and (N,) ``rows`` which of them each point sees.
        """
        names = [f"density_{i}" for i in range(len(self.architecture.density_shapes))]
        features = encode(self.box.normalised(positions), parameters["table"], self.architecture.levels)
        return network(features, conditions, rows, [parameters[name] for name in names])

    def density(self, latent: Tensor, distances: Tensor) -> Tensor:
        """(N,) per metre, at (N,) distances from the mesh."""
        return _BoundedExp.apply(latent[:, 0] + self.prior(distances))  # type: ignore[no-untyped-call]

    def color(self, parameters: Parameters, latent: Tensor, directions: Tensor) -> Tensor:
        """(N, 3) in (0, 1) for (N, 3) canonical unit directions along the rays."""
        names = [f"color_{i}" for i in range(len(self.architecture.color_shapes))]
        basis = sh_basis(directions, SH_DEGREE)
        rows = torch.arange(len(basis), device=basis.device)
        return torch.sigmoid(network(latent, basis, rows, [parameters[name] for name in names]))


class _BoundedExp(torch.autograd.Function):
    """exp with a bounded argument; the gradient keeps flowing at the bound, so that nothing gets stuck there."""

    @staticmethod
    def forward(ctx, values: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        result = torch.exp(values.clamp(max=LOG_DENSITY_MAX))
        ctx.save_for_backward(result)
        return result

    @staticmethod
    def backward(ctx, *grads: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        (result,) = ctx.saved_tensors
        return grads[0] * result
