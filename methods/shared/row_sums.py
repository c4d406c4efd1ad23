"""Weighted sums of table rows, the common core of sampled planes and lines, with adjoints made for the CPU."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag


def sum_rows(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """(N, C) sums over k of ``weights[:, k] * table[rows[:, k]]``; differentiable in table and weights.

    Parameters
    ----------
    table : (T, C).
    rows : (N, K) int64.
    weights : (N, K), of the table's dtype.
    """
    return _SumRows.apply(table, rows, weights)  # type: ignore[no-untyped-call]


class _SumRows(torch.autograd.Function):
    """The adjoint by the table is one sparse product: torch's own sorts all the row numbers first."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(table, rows, weights)
        return embedding_bag(rows, table, per_sample_weights=weights, mode="sum")

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        table, rows, weights = ctx.saved_tensors
        gradient = grads[0].contiguous()
        by_table = by_weights = None
        if ctx.needs_input_grad[0]:
            owners = torch.arange(len(rows), device=rows.device).repeat_interleave(rows.shape[1])
            entries = torch.stack([rows.reshape(-1), owners])
            spread = torch.sparse_coo_tensor(
                entries, weights.reshape(-1), (len(table), len(rows)), check_invariants=False
            )
            by_table = spread @ gradient
        if ctx.needs_input_grad[2]:
            with torch.enable_grad():
                leaf = weights.detach().requires_grad_()
                summed = embedding_bag(rows, table.detach(), per_sample_weights=leaf, mode="sum")
            (by_weights,) = torch.autograd.grad(summed, leaf, gradient)
        return by_table, None, by_weights
