"""Both networks of "ours" in training by the compiled kernel: colours of the planes, offsets of the lines.

The definitions are `field.shade` of `field.plane_features`, and `field.line_offsets`; they are used where the kernel is
not (`avatar_kernel.usable`). Results do not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..shared.avatar_kernel import arrays, call
from ..shared.threads import threads
from .field import COLOR_NETWORK, Bounds, CanonicalFrames, NamedTensors, line_table, normalised_weight


def plane_colors(
    parameters: NamedTensors,
    box: Bounds,
    positions: Tensor,
    directions: Tensor,
    backend: str = "cpu",
) -> Tensor:
    """Colours (N, 3) >= 0 of (N, 3) canonical positions seen along (N, 3) canonical unit vectors."""
    network = (parameters[name] for name in COLOR_NETWORK)
    return _Colors.apply(torch.stack([*box]), backend, positions, directions, *network)  # type: ignore[no-untyped-call]


def table_offsets(
    parameters: NamedTensors,
    box: Bounds,
    blended: Tensor,
    positions: Tensor,
    backend: str = "cpu",
) -> Tensor:
    """(N, D) offsets at (N, 3) canonical positions, 0 outside the box; without gradient by positions.

    Parameters
    ----------
    blended : (2, 3, L, C), see `field.blend_lines`.
    """
    return _Offsets.apply(  # type: ignore[no-untyped-call]
        *(positions.detach(), torch.stack([*box]), backend),
        *(line_table(blended, normalised_weight(parameters, 0)), parameters["line_bias_0"]),
        *(normalised_weight(parameters, 1), parameters["line_bias_1"]),
        *(normalised_weight(parameters, 2), parameters["line_bias_2"]),
    )


def directions_to(
    turns: Tensor,
    binding: Tensor,
    means: Tensor,
    center: Tensor,
    last: Tensor | None = None,
    backend: str = "cpu",
) -> Tensor:
    """Compiled form of `field.canonical_directions`; then the rotation ``last`` (3, 3), if any, is applied to all."""
    last = torch.eye(3) if last is None else last
    return _Directions.apply(binding, turns, last, center, backend, means)  # type: ignore[no-untyped-call]


def canonical_positions(
    canonical: CanonicalFrames, binding: Tensor, means: Tensor, backend: str = "cpu"
) -> Tensor:
    """Compiled form of `field.CanonicalFrames.positions`; only ``means`` receive a gradient."""
    return _Positions.apply(binding, canonical.linear, canonical.center, backend, means)  # type: ignore[no-untyped-call]


class _Positions(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, binding: Tensor, linear: Tensor, center: Tensor, backend: str, means: Tensor
    ) -> Tensor:
        positions = torch.empty_like(means)
        call("position_training", binding, linear, center, means, positions, False, backend=backend)
        ctx.save_for_backward(binding, linear, center)
        ctx.backend = backend
        return positions

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_positions: Tensor) -> tuple[Tensor | None, ...]:
        by_means = torch.empty_like(by_positions)
        call("position_training", *ctx.saved_tensors, by_positions, by_means, True, backend=ctx.backend)
        return None, None, None, None, by_means


class _Directions(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        *fixed, backend, means = inputs
        directions = torch.empty_like(means)
        call("direction_training", *fixed, means, means.new_empty(0, 3), directions, backend=backend)
        ctx.save_for_backward(*fixed, means)
        ctx.backend = backend
        return directions

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_directions: Tensor) -> tuple[Tensor | None, ...]:
        by_means = torch.empty_like(by_directions)
        call("direction_training", *ctx.saved_tensors, by_directions, by_means, backend=ctx.backend)
        return None, None, None, None, None, by_means


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, box: Tensor, backend: str, *inputs: Tensor) -> Tensor:
        colors = torch.empty_like(inputs[0])
        ctx.done = call("color_training", *inputs, box, colors, backend=backend)
        ctx.save_for_backward(*inputs, box, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_colors: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, box, colors = ctx.saved_tensors
        places, weights = inputs[:2], inputs[2:]
        wanted = any(ctx.needs_input_grad[2:4])
        by_places = [torch.empty_like(value) if wanted else value.new_empty(0, 3) for value in places]
        gradients = [torch.empty_like(value) for value in weights]
        ctx.done.backward(*arrays(*inputs, box, colors, by_colors, *by_places, *gradients), threads())
        return None, None, *(by_places if wanted else [None] * 2), *gradients


class _Offsets(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, box: Tensor, backend: str, *weights: Tensor) -> Tensor:
        offsets = positions.new_zeros(len(positions), len(weights[-1]))
        ctx.done = call("line_training", *weights, positions, box, offsets, backend=backend)
        ctx.save_for_backward(*weights)
        return offsets

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_offsets: Tensor) -> tuple[Tensor | None, ...]:
        weights = ctx.saved_tensors
        gradients = [torch.empty_like(value) for value in weights]
        ctx.done.backward(*arrays(*weights, by_offsets, *gradients), threads())
        return None, None, None, *gradients
