"""Both networks of "ours" in training by the compiled kernel: colours of the planes, offsets of the lines.

The definitions are `field.shade` of `field.plane_features`, and `field.line_offsets`; they are used where the kernel is
not (`usable`). Results do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..shared import avatar_kernel
from ..shared.networks import PAIRS
from ..splats.cpu import KERNEL, instruction_sets
from .field import Bounds, NamedTensors, line_table, normalised_weight


def usable(like: Tensor) -> bool:
    """Tell whether the kernel is there and takes tensors like this one; one built from older sources does not."""
    return avatar_kernel.usable(like) and hasattr(KERNEL.imported, "color_training")


def plane_colors(
    parameters: NamedTensors,
    box: Bounds,
    positions: Tensor,
    directions: Tensor,
    splats: Tensor | None = None,
    backend: str = "cpu",
) -> Tensor:
    """Colours (N, 3) >= 0 of (N, 3) canonical positions seen along (N, 3) canonical unit vectors.

    Parameters
    ----------
    splats : (M,) int64, those to compute, each once; the others are black and add to no gradient. None: all.
    """
    if splats is None:
        splats = torch.arange(len(positions))
    planes = (parameters[f"plane_{name}"] for name, _, _ in PAIRS)
    weights = parameters["color_weight_0"], parameters["color_weight_1"]
    settings = torch.stack([*box]), splats, instruction_sets()[backend]
    return _Colors.apply(settings, positions, directions, *planes, *weights)  # type: ignore[no-untyped-call]


def table_offsets(
    parameters: NamedTensors,
    box: Bounds,
    blended: Tensor,
    positions: Tensor,
    wanted: Tensor | None = None,
    backend: str = "cpu",
) -> Tensor:
    """(N, D) offsets at (N, 3) canonical positions, 0 outside the box; without gradient by positions.

    Parameters
    ----------
    blended : (2, 3, L, C), see `field.blend_lines`.
    wanted : (N,) bool; the offsets of the others are 0 too. None: all.
    """
    mask = torch.empty(0, dtype=torch.uint8) if wanted is None else wanted.view(torch.uint8)
    return _Offsets.apply(  # type: ignore[no-untyped-call]
        (positions.detach(), mask, torch.stack([*box]), instruction_sets()[backend]),
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
    return _Directions.apply(binding, turns, last, center, instruction_sets()[backend], means)  # type: ignore[no-untyped-call]


class _Directions(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        *fixed, instruction_set, means = inputs
        fixed = [value.contiguous() for value in (*fixed, means)]
        ctx.instruction_set, directions = instruction_set, torch.empty_like(fixed[-1])
        _direct(fixed, means.new_empty(0, 3), directions, instruction_set)
        ctx.save_for_backward(*fixed)
        return directions

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_directions: Tensor) -> tuple[Tensor | None, ...]:
        by_means = torch.empty_like(by_directions)
        _direct(ctx.saved_tensors, by_directions.contiguous(), by_means, ctx.instruction_set)
        return None, None, None, None, None, by_means


def _direct(inputs: Sequence[Tensor], by_directions: Tensor, out: Tensor, instruction_set: str) -> None:
    arrays = _arrays(*inputs, by_directions, out)
    KERNEL.load().direction_training(*arrays, instruction_set, torch.get_num_threads())


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, settings: tuple[Tensor, Tensor, str], *inputs: Tensor) -> Tensor:
        box, splats, instruction_set = settings
        inputs = tuple(value.contiguous() for value in inputs)
        colors = torch.zeros_like(inputs[0])
        ctx.done = KERNEL.load().color_training(
            *_arrays(*inputs, box, splats, colors), instruction_set, torch.get_num_threads()
        )
        ctx.save_for_backward(*inputs, box, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_colors: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, box, colors = ctx.saved_tensors
        # The kernel writes the positions and directions of its splats alone, and all of the rest.
        gradients = [torch.zeros_like(value) for value in inputs[:2]]
        gradients += [torch.empty_like(value) for value in inputs[2:]]
        ctx.done.backward(
            *_arrays(*inputs, box, colors, by_colors.contiguous(), *gradients), torch.get_num_threads()
        )
        return None, *gradients


class _Offsets(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, settings: tuple[Tensor, Tensor, Tensor, str], *weights: Tensor) -> Tensor:
        positions, wanted, box, instruction_set = settings
        weights = tuple(value.contiguous() for value in weights)
        offsets = positions.new_zeros(len(positions), len(weights[-1]))
        ctx.done = KERNEL.load().line_training(
            *_arrays(*weights, positions.contiguous(), wanted.contiguous(), box, offsets),
            *(instruction_set, torch.get_num_threads()),
        )
        ctx.save_for_backward(*weights)
        return offsets

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_offsets: Tensor) -> tuple[Tensor | None, ...]:
        weights = ctx.saved_tensors
        gradients = [torch.empty_like(value) for value in weights]
        ctx.done.backward(*_arrays(*weights, by_offsets.contiguous(), *gradients), torch.get_num_threads())
        return None, *gradients


def _arrays(*tensors: Tensor) -> list[Any]:
    return [tensor.detach().numpy() for tensor in tensors]
