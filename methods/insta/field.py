"""The canonical radiance field: hash encoding, density network, colour network."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...bench.native.dispatch import Operation
from ..ops.planes import sh_basis
from ..shared.schedule import torch_generator
from ..shared.threads import threads
from . import kernel
from .spec import InstaConfig

SH_DEGREE = 3  # 16 basis functions; the published program calls that degree 4
DIRECTIONS = (SH_DEGREE + 1) ** 2
LOG_DENSITY_MAX = 15.0  # limit of its gradient, as published; keeps a sample's thickness finite

Parameters = Mapping[str, Tensor]


class EncodedCube(NamedTuple):
    """Cube of canonical space that the encoding covers: (3,) lower corner and side, metres."""

    low: Tensor
    side: float

    def normalised(self, positions: Tensor) -> Tensor:
        """Positions in [0, 1]."""
        return ((positions - self.low) / self.side).clamp(0, 1)


class Prior(NamedTuple):
    """Logarithm of the density before training: highest at the mesh. See `InstaConfig`."""

    bias: float
    depth: float
    scale: float

    @classmethod
    def of(cls, config: InstaConfig) -> Prior:
        """The density prior of a configuration."""
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

    @classmethod
    def of(cls, config: InstaConfig, expressions: int) -> Architecture:
        """Sizes for a configuration and a number of expression coefficients."""
        c, conditions = config, min(config.conditions, expressions)
        return cls(
            make_levels(c.levels, c.base_resolution, c.finest_resolution, c.log2_table),
            c.level_features,
            layer_shapes(c.levels * c.level_features + conditions, c.hidden, c.density_layers, c.latent),
            layer_shapes(c.latent + DIRECTIONS, c.hidden, c.color_layers, 3),
            conditions,
        )

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of every parameter by name."""
        named: dict[str, tuple[int, ...]] = {"table": (table_rows(self.levels), self.features)}
        named |= {f"density_{i}": shape for i, shape in enumerate(self.density_shapes)}
        return named | {f"color_{i}": shape for i, shape in enumerate(self.color_shapes)}

    def initial(self, seed: int) -> dict[str, Tensor]:
        """Parameters to start training from."""
        generator = torch_generator(seed, "insta field")
        shapes = self.shapes()
        table = (2 * torch.rand(shapes.pop("table"), generator=generator) - 1) * INITIAL
        return {"table": table, **{name: initial_weight(s, generator) for name, s in shapes.items()}}


class RadianceField:
    """Density and colour at canonical points; ``prior`` is added to the logarithm of the density per metre."""

    def __init__(self, architecture: Architecture, box: EncodedCube, prior: Prior):
        self.architecture, self.box, self.prior = architecture, box, prior

    def latent(self, parameters: Parameters, positions: Tensor, conditions: Tensor, rows: Tensor) -> Tensor:
        """(N, L) outputs of the density network at (N, 3) positions, metres; of (M, K) ``conditions``, sets of
        coefficients, each point sees that of its (N,) ``rows``."""
        weights = [parameters[f"density_{i}"] for i in range(len(self.architecture.density_shapes))]
        features = encode(parameters["table"], self.box.normalised(positions), self.architecture.levels)
        return network(features, conditions, rows, weights)

    def density(self, latent: Tensor, distances: Tensor) -> Tensor:
        """(N,) per metre, at (N,) distances from the mesh."""
        return _BoundedExp.apply(latent[:, 0] + self.prior(distances))  # type: ignore[no-untyped-call]

    def color(self, parameters: Parameters, latent: Tensor, directions: Tensor) -> Tensor:
        """(N, 3) in (0, 1) for (N, 3) canonical unit directions along the rays."""
        weights = [parameters[f"color_{i}"] for i in range(len(self.architecture.color_shapes))]
        basis = sh_basis(directions, SH_DEGREE)
        return torch.sigmoid(network(latent, basis, torch.arange(len(basis), device=basis.device), weights))


class _BoundedExp(torch.autograd.Function):
    """exp with a clamped argument; the gradient does not vanish at the bound, so values can return."""

    @staticmethod
    def forward(ctx, values: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        result = torch.exp(values.clamp(max=LOG_DENSITY_MAX))
        ctx.save_for_backward(result)
        return result

    @staticmethod
    def backward(ctx, *grads: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        (result,) = ctx.saved_tensors
        return grads[0] * result


PRIMES = (1, 2654435761, 805459861)
INITIAL = 1e-4  # features start uniform in +-INITIAL


class Level(NamedTuple):
    """One level: cells per unit length, samples per side, and its rows of the table."""

    scale: float
    resolution: int
    first: int
    rows: int


def make_levels(count: int, base: int, finest: int, log2_table: int) -> tuple[Level, ...]:
    """Levels whose resolutions grow geometrically from ``base`` to ``finest``.

    A level has one row per sample, rounded up to 8, if that is at most ``2**log2_table``; otherwise rows are shared by
    a hash. Sizes are those of the published program, which shifts positions by half a cell and so reads the samples of
    the last half cell from the other side; here the first sample lies at 0.
    """
    growth = (math.log2(finest) - math.log2(base)) / (count - 1) if count > 1 else 0.0
    levels, first = [], 0
    for number in range(count):
        scale = base * 2 ** (number * growth) - 1
        # The last level's scale is an integer up to rounding, which must not add a sample.
        resolution = math.ceil(scale - 1e-6) + 1
        rows = min(-(-(resolution**3) // 8) * 8, 2**log2_table)
        levels.append(Level(scale, resolution, first, rows))
        first += rows
    return tuple(levels)


def table_rows(levels: Sequence[Level]) -> int:
    """Rows of the table of all levels."""
    return levels[-1].first + levels[-1].rows


@Operation
def encode(table: Tensor, positions: Tensor, levels: Sequence[Level]) -> Tensor:
    """(N, levels * features) values at (N, 3) positions in [0, 1]: trilinear sums of eight rows on every level.

    In the compiled form, only the (rows, features) table receives a gradient, and its dtype selects the precision.
    """
    corners = torch.tensor([[c >> axis & 1 for axis in range(3)] for c in range(8)], device=positions.device)
    parts = []
    for level in levels:
        scaled = positions * level.scale
        below = scaled.floor()
        part = (scaled - below)[:, None]
        at = below.long()[:, None] + corners
        weights = torch.where(corners.bool(), part, 1 - part).prod(2)
        rows = level.first + _rows(at, level)
        parts.append((weights[..., None] * table[rows]).sum(1))
    return torch.cat(parts, dim=1)


@encode.compiled(kernel.KERNEL)
def _encode(table: Tensor, positions: Tensor, levels: Sequence[Level]) -> Tensor:
    return _Encode.apply(positions.detach().contiguous(), table, tuple(levels))  # type: ignore[no-untyped-call]


def _rows(at: Tensor, level: Level) -> Tensor:
    if level.resolution**3 <= level.rows:
        flat = at[..., 0] + level.resolution * (at[..., 1] + level.resolution * at[..., 2])
        return flat % level.rows
    mixed = at[..., 0] * PRIMES[0] ^ at[..., 1] * PRIMES[1] ^ at[..., 2] * PRIMES[2]
    return mixed & (level.rows - 1)


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, table: Tensor, levels: tuple[Level, ...]) -> Tensor:
        ctx.save_for_backward(positions)
        ctx.levels, ctx.shape = levels, table.shape
        out = table.new_empty(len(positions), len(levels) * table.shape[1])
        module: Any = kernel.load()
        arrays = positions.numpy(), table.detach().numpy()
        module.encode(*arrays, list(levels), out.numpy(), threads())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (positions,) = ctx.saved_tensors
        by_table = grads[0].new_zeros(ctx.shape)
        module: Any = kernel.load()
        arrays = positions.numpy(), grads[0].contiguous().numpy()
        module.encode_backward(*arrays, list(ctx.levels), by_table.numpy(), threads())
        return None, by_table, None


BLOCK = 2048  # rows per block; their activations fit a core's second-level cache


def layer_shapes(inputs: int, hidden: int, layers: int, outputs: int) -> list[tuple[int, int]]:
    """(out, in) of every weight of a network with a number of hidden layers."""
    widths = [inputs, *[hidden] * layers, outputs]
    return [(widths[i + 1], widths[i]) for i in range(len(widths) - 1)]


def initial_weight(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Uniform within +-sqrt(6 / (in + out)): Glorot and Bengio, as tiny-cuda-nn starts its networks."""
    return (2 * torch.rand(*shape, generator=generator) - 1) * math.sqrt(6 / sum(shape))


def network(inputs: Tensor, constants: Tensor, rows: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """(N, out) of layers with ReLU between them, applied to [inputs, constants[rows]].

    ``inputs`` are (N, C), ``constants`` (M, K), which get no gradient (K may be 0), ``rows`` (N,) int64.
    """
    return _Network.apply(inputs, constants, rows, *weights)  # type: ignore[no-untyped-call]


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor, constants: Tensor, rows: Tensor, *weights: Tensor) -> Tensor:
        keep = any(ctx.needs_input_grad)
        outputs = inputs.new_empty(len(inputs), len(weights[-1]))
        saved: list[Tensor] = []
        for block in _blocks(inputs):
            values = inputs[block]
            if constants.shape[1]:
                values = torch.cat([values, constants.index_select(0, rows[block])], dim=1)
            for weight in weights[:-1]:
                if keep:
                    saved.append(values)
                values = (values @ weight.t()).relu_()
            if keep:
                saved.append(values)
            outputs[block] = values @ weights[-1].t()
        ctx.width = inputs.shape[1]
        ctx.save_for_backward(*weights, *saved)
        return outputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        count = len(ctx.needs_input_grad) - 3
        weights, saved = ctx.saved_tensors[:count], ctx.saved_tensors[count:]
        gradient = grads[0]
        by_weights = [torch.zeros_like(weight) for weight in weights]
        by_inputs = gradient.new_empty(len(gradient), ctx.width)
        for number, block in enumerate(_blocks(gradient)):
            values = saved[number * count : (number + 1) * count]
            by_values = gradient[block]
            for layer in range(count - 1, -1, -1):
                by_weights[layer].addmm_(by_values.t(), values[layer])
                if layer:
                    by_values = torch.ops.aten.threshold_backward(
                        by_values @ weights[layer], values[layer], 0.0
                    )
            by_inputs[block] = by_values @ weights[0][:, : ctx.width]
        return by_inputs, None, None, *by_weights


def _blocks(rows: Tensor) -> list[slice]:
    return [slice(start, start + BLOCK) for start in range(0, len(rows), BLOCK)]
