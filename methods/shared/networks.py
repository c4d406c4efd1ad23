"""The two small networks of "ours", evaluated in blocks of rows that stay in cache, with adjoints in closed form.

Autograd over the same layers is the slow twin the tests compare with; it takes about twice the time, most of it
in moving activations of all splats to memory and back.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from .sh import C0
from .triplane import ENCODING_SIZE, FREQUENCIES, encode_directions

CPU_BLOCK = 2048  # rows; their activations fit a core's second-level cache


def color_network(first: Tensor, last: Tensor, features: tuple[Tensor, ...], directions: Tensor) -> Tensor:
    """Colours (N, 3) >= 0: [features, encoded direction] -> hidden -> ReLU -> relu(0.5 + C0 * out), no bias.

    Parameters
    ----------
    first, last : (H, C + 27) and (3, H) weights.
    features : (N, C_k) each, their C_k adding up to C.
    directions : (N, 3) unit vectors.
    """
    return _Color.apply(first, last, directions, *features)  # type: ignore[no-untyped-call]


def offset_network(
    summed: Tensor, bias_0: Tensor, weight_1: Tensor, bias_1: Tensor, weight_2: Tensor, bias_2: Tensor
) -> Tensor:
    """(N, 1): what follows the linear first layer of (N, H) ``summed``: bias, ReLU, layer, ReLU, layer."""
    return _Offset.apply(summed, bias_0, weight_1, bias_1, weight_2, bias_2)  # type: ignore[no-untyped-call]


class _Color(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, first: Tensor, last: Tensor, directions: Tensor, *features: Tensor) -> Tensor:
        keep = any(ctx.needs_input_grad)
        colors = directions.new_empty(len(directions), len(last))
        half = directions.new_tensor(0.5)
        saved: list[Tensor] = []
        for rows in _blocks(directions):
            inputs = torch.cat([*(f[rows] for f in features), encode_directions(directions[rows])], dim=1)
            hidden = (inputs @ first.t()).relu_()
            colors[rows] = torch.addmm(half, hidden, last.t(), alpha=C0).relu_()
            if keep:
                saved += [inputs, hidden]
        ctx.widths = [f.shape[1] for f in features]
        ctx.save_for_backward(first, last, colors, *saved)
        return colors

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        first, last, colors, *saved = ctx.saved_tensors
        by_first, by_last = torch.zeros_like(first), torch.zeros_like(last)
        by_directions = colors.new_empty(len(colors), 3)
        by_features = [colors.new_empty(len(colors), width) for width in ctx.widths]
        for number, rows in enumerate(_blocks(colors)):
            inputs, hidden = saved[2 * number], saved[2 * number + 1]
            by_out = C0 * _relu_adjoint(grads[0][rows], colors[rows])
            by_last.addmm_(by_out.t(), hidden)
            by_hidden = _relu_adjoint(by_out @ last, hidden)
            by_first.addmm_(by_hidden.t(), inputs)
            by_inputs = by_hidden @ first
            parts = by_inputs.split([*ctx.widths, ENCODING_SIZE], dim=1)
            for whole, part in zip(by_features, parts):
                whole[rows] = part
            by_directions[rows] = _encoding_adjoint(inputs[:, -ENCODING_SIZE:], parts[-1])
        return by_first, by_last, by_directions, *by_features


class _Offset(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        summed: Tensor,
        bias_0: Tensor,
        weight_1: Tensor,
        bias_1: Tensor,
        weight_2: Tensor,
        bias_2: Tensor,
    ) -> Tensor:
        keep = any(ctx.needs_input_grad)
        offsets = summed.new_empty(len(summed), len(weight_2))
        saved: list[Tensor] = []
        for rows in _blocks(summed):
            hidden_0 = (summed[rows] + bias_0).relu_()
            hidden_1 = torch.addmm(bias_1, hidden_0, weight_1.t()).relu_()
            offsets[rows] = torch.addmm(bias_2, hidden_1, weight_2.t())
            if keep:
                saved += [hidden_0, hidden_1]
        ctx.save_for_backward(weight_1, weight_2, *saved)
        return offsets

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        weight_1, weight_2, *saved = ctx.saved_tensors
        gradient = grads[0]
        by_summed = gradient.new_empty(len(gradient), weight_1.shape[1])
        by_bias_0, by_bias_1 = weight_1.new_zeros(weight_1.shape[1]), weight_1.new_zeros(len(weight_1))
        by_weight_1, by_weight_2 = torch.zeros_like(weight_1), torch.zeros_like(weight_2)
        for number, rows in enumerate(_blocks(gradient)):
            hidden_0, hidden_1 = saved[2 * number], saved[2 * number + 1]
            by_out = gradient[rows]
            by_weight_2.addmm_(by_out.t(), hidden_1)
            by_hidden_1 = _relu_adjoint(by_out @ weight_2, hidden_1)
            by_bias_1 += by_hidden_1.sum(0)
            by_weight_1.addmm_(by_hidden_1.t(), hidden_0)
            by_hidden_0 = _relu_adjoint(by_hidden_1 @ weight_1, hidden_0)
            by_bias_0 += by_hidden_0.sum(0)
            by_summed[rows] = by_hidden_0
        return by_summed, by_bias_0, by_weight_1, by_bias_1, by_weight_2, gradient.sum(0)


def _relu_adjoint(gradient: Tensor, value: Tensor) -> Tensor:
    """The gradient where the ReLU's value is positive, else 0; one pass."""
    return torch.ops.aten.threshold_backward(gradient, value, 0.0)


def _encoding_adjoint(encoded: Tensor, gradient: Tensor) -> Tensor:
    """Gradient by directions, (n, 3), of `encode_directions` from its (n, 27) values and their gradient."""
    waves, by_waves = (values[:, 3:].reshape(-1, len(FREQUENCIES), 2, 3) for values in (encoded, gradient))
    turned = by_waves[:, :, 0] * waves[:, :, 1] - by_waves[:, :, 1] * waves[:, :, 0]
    return gradient[:, :3] + (turned * gradient.new_tensor(FREQUENCIES)[:, None]).sum(1)


def _blocks(rows: Tensor) -> Iterator[slice]:
    step = CPU_BLOCK if rows.device.type == "cpu" else max(len(rows), 1)
    return (slice(start, start + step) for start in range(0, len(rows), step))
