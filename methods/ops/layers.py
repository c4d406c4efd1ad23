"""Layers of networks."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import leaky_relu, linear

from ...bench.native.dispatch import Operation
from .kernel import KERNEL

ROWS_STEP = 128
"""The compiled form is for numbers of rows that are multiples of this: oneDNN generates code for each number of rows, which takes
as long as several products."""


@Operation
def layer(values: Tensor, weight: Tensor, bias: Tensor, slope: float = 1.0) -> Tensor:
    """(..., O) ``values @ weight.T + bias`` of (..., I), (O, I) and (O,), negative results times ``slope``.

    The compiled form calls oneDNN, whose float32 products use the whole vectors of every processor; torch itself calls MKL,
    which uses half of an AVX-512 vector on those of AMD.
    """
    result = linear(values, weight, bias)
    return result if slope == 1 else leaky_relu(result, slope)


@layer.compiled(KERNEL)
def _layer(values: Tensor, weight: Tensor, bias: Tensor, slope: float = 1.0) -> Tensor:
    rows = values.flatten(0, -2)
    if not len(rows) or len(rows) % ROWS_STEP or not hasattr(torch.ops.mkldnn, "_linear_pointwise"):
        return layer.definition(values, weight, bias, slope)
    result: Tensor = _Layer.apply(rows, weight, bias, slope)  # type: ignore[no-untyped-call]
    return result.view(*values.shape[:-1], len(weight))


class _Layer(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, weight: Tensor, bias: Tensor, slope: float) -> Tensor:
        result = _product(values, weight, bias, slope)
        ctx.slope = slope
        ctx.save_for_backward(values, weight, result)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_result: Tensor) -> tuple[Tensor | None, ...]:
        values, weight, result = ctx.saved_tensors
        if ctx.slope != 1:
            by_result = torch.ops.aten.leaky_relu_backward(by_result, result, ctx.slope, True)
        by_values = _product(by_result, weight.t()) if ctx.needs_input_grad[0] else None
        # The product is faster with more columns than rows.
        few, many = by_result.t(), values.t()
        by_weight = _product(few, many) if len(few) < len(many) else _product(many, few).t()
        return by_values, by_weight, by_result.sum(0), None


def _product(left: Tensor, right: Tensor, bias: Tensor | None = None, slope: float = 1.0) -> Tensor:
    """(M, N) ``leaky_relu(left @ right.T + bias)`` of (M, K) and (N, K)."""
    if not right.t().is_contiguous():
        right = right.contiguous()  # oneDNN takes thousands of times as long for parts of a matrix
    activation = ("none", [], "") if slope == 1 else ("leaky_relu", [slope], "")
    result: Tensor = torch.ops.mkldnn._linear_pointwise(left, right, bias, *activation)
    return result
