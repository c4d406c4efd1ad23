"""ReLU networks without biases, evaluated in blocks of rows that stay in cache, with adjoints in closed form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

CPU_BLOCK = 2048  # rows; their activations fit a core's second-level cache


def layer_shapes(inputs: int, hidden: int, layers: int, outputs: int) -> list[tuple[int, int]]:
    """(out, in) of every weight of a network with so many hidden layers."""
    widths = [inputs, *[hidden] * layers, outputs]
    return [(widths[i + 1], widths[i]) for i in range(len(widths) - 1)]


def initial_weights(shapes: Sequence[tuple[int, int]], generator: torch.Generator) -> list[Tensor]:
    """Uniform within +-sqrt(6 / (in + out)): Glorot and Bengio, as tiny-cuda-nn starts its networks."""
    return [
        (2 * torch.rand(shape, generator=generator) - 1) * math.sqrt(6 / (shape[0] + shape[1]))
        for shape in shapes
    ]


def network(inputs: Tensor, constants: Tensor, rows: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """(N, out) of layers with ReLU between them, applied to [inputs, constants[rows]].

    Parameters
    ----------
    inputs : (N, C).
    constants : (M, K) that get no gradient; K may be 0.
    rows : (N,) int64.
    """
    return _Network.apply(inputs, constants, rows, *weights)  # type: ignore[no-untyped-call]


def network_reference(inputs: Tensor, constants: Tensor, rows: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """Twin of `network`, by autograd."""
    values = torch.cat([inputs, constants[rows]], dim=1)
    for weight in weights[:-1]:
        values = torch.relu(values @ weight.t())
    return values @ weights[-1].t()


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
    step = CPU_BLOCK if rows.device.type == "cpu" else max(len(rows), 1)
    return [slice(start, start + step) for start in range(0, len(rows), step)]
