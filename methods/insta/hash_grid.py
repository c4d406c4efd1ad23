"""Multi-resolution hash encoding (Mueller et al., "Instant Neural Graphics Primitives", SIGGRAPH 2022, section 3).

All levels live in one table, (rows, features), coarse levels first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from . import kernel

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

    A level has one row per sample, rounded up to 8, as long as that is no more than ``2**log2_table``; beyond that
    rows are shared by a hash. Sizes are those of the published program, which shifts positions by half a cell and so
    reads the samples of the last half cell from the other side; here the first sample lies at 0.
    """
    growth = (math.log2(finest) - math.log2(base)) / (count - 1) if count > 1 else 0.0
    levels, first = [], 0
    for number in range(count):
        scale = base * 2 ** (number * growth) - 1
        # The last level's scale is a whole number up to rounding, which must not add a sample.
        resolution = math.ceil(scale - 1e-6) + 1
        rows = min(-(-(resolution**3) // 8) * 8, 2**log2_table)
        levels.append(Level(scale, resolution, first, rows))
        first += rows
    return tuple(levels)


def table_rows(levels: Sequence[Level]) -> int:
    """Rows of the table of all levels."""
    return levels[-1].first + levels[-1].rows


def encode(positions: Tensor, table: Tensor, levels: Sequence[Level], backend: str = "auto") -> Tensor:
    """(N, levels * features) values at (N, 3) positions in [0, 1]; differentiable in the (rows, features) table.

    ``backend`` "reference" is the definition in torch, for any type and device; "auto" takes the kernel for float32
    on the CPU.
    """
    module = kernel.load() if backend == "auto" else None
    if module is None or table.device.type != "cpu" or table.dtype != torch.float32:
        return encode_reference(positions, table, levels)
    return _Encode.apply(positions.detach().contiguous(), table, tuple(levels))  # type: ignore[no-untyped-call]


def encode_reference(positions: Tensor, table: Tensor, levels: Sequence[Level]) -> Tensor:
    """Twin of the kernel: trilinear sums of eight rows on every level."""
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
        module = kernel.load()
        assert module is not None
        arrays = positions.numpy(), table.detach().numpy()
        module.encode(*arrays, list(levels), out.numpy(), torch.get_num_threads())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (positions,) = ctx.saved_tensors
        by_table = grads[0].new_zeros(ctx.shape)
        module = kernel.load()
        assert module is not None
        arrays = positions.numpy(), grads[0].contiguous().numpy()
        module.encode_backward(*arrays, list(ctx.levels), by_table.numpy(), torch.get_num_threads())
        return None, by_table, None
