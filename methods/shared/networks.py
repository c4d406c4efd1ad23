"""The two small networks of "ours", evaluated in blocks of rows that stay in cache, with adjoints in closed form.

Autograd over the same layers is the reference that the tests compare with; it takes about twice the time, most of it
in moving activations of all splats to memory and back.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

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
        half = directions.new_full((), 0.5)
        saved: list[Tensor] = []
        for rows in _blocks(directions):
            inputs = torch.cat([*(f[rows] for f in features), encode(directions[rows])], dim=1)
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
    """Gradient by directions, (n, 3), of `encode` from its (n, 27) values and their gradient."""
    waves, by_waves = (values[:, 3:].reshape(-1, len(FREQUENCIES), 2, 3) for values in (encoded, gradient))
    turned = by_waves[:, :, 0] * waves[:, :, 1] - by_waves[:, :, 1] * waves[:, :, 0]
    return gradient[:, :3] + (turned * _frequencies(gradient.dtype, gradient.device)[:, None]).sum(1)


def _blocks(rows: Tensor) -> Iterator[slice]:
    step = CPU_BLOCK if rows.device.type == "cpu" else max(len(rows), 1)
    return (slice(start, start + step) for start in range(0, len(rows), step))


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


PAIRS = (("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2))
"""Planes in the order of their features: name, coordinate along the width, coordinate along the height."""


FREQUENCIES = (1.0, 2.0, 4.0, 8.0)
ENCODING_SIZE = 3 + 2 * 3 * len(FREQUENCIES)


def sample_plane(plane: Tensor, coordinates: Tensor, resolution: int) -> Tensor:
    """Features (N, C) of a (R * R, C) plane at (N, 2) coordinates in [-1, 1], width first; clamped outside.

    Bilinear, align-corners, border padding, as ``torch.nn.functional.grid_sample`` defines them.
    """
    position = ((coordinates + 1) * (0.5 * (resolution - 1))).clamp(0, resolution - 1)
    corner = position.detach().floor().clamp_max(resolution - 2)
    u, v = (position - corner).unbind(1)
    column, row = corner.to(torch.int64).unbind(1)
    first = row * resolution + column
    indices = torch.stack([first, first + 1, first + resolution, first + resolution + 1], dim=1)
    weights = torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], dim=1)
    return sum_rows(plane, indices, weights)


def sample_triplane(planes: dict[str, Tensor], points: Tensor, resolution: int) -> tuple[Tensor, ...]:
    """Features of the three planes at (N, 3) points in [-1, 1], in the order of `PAIRS`."""
    return tuple(
        # The two coordinates by steps: a list of numbers would be copied to the device.
        sample_plane(planes[name], points[:, width : height + 1 : height - width], resolution)
        for name, width, height in PAIRS
    )


def encode(values: Tensor) -> Tensor:
    """(N, 9 D) positional encoding of (N, D) values: identity, then sin and cos at 1, 2, 4, 8 (no pi)."""
    frequencies = _frequencies(values.dtype, values.device)
    angles = frequencies[:, None] * values[:, None, :]
    waves = torch.stack([torch.sin(angles), torch.cos(angles)], dim=2)
    return torch.cat([values, waves.flatten(1)], dim=1)


@functools.cache
def _frequencies(dtype: torch.dtype, device: torch.device) -> Tensor:
    """`FREQUENCIES` where they are used: made at each call, the host would wait for the device."""
    return torch.tensor(FREQUENCIES, dtype=dtype).to(device)


def smoothing(spread: float) -> Tensor:
    """(9 D,) factors on `encode` of D = 3 values known to the standard deviation ``spread``, which make it its mean.

    Of x + n, n normal: a wave of frequency f keeps exp(-(f spread)^2 / 2) (integrated positional encoding; Barron et al.
    2021, arXiv 2103.13415, eq. 13).
    """
    frequencies = torch.tensor(FREQUENCIES).repeat_interleave(2 * 3)
    return torch.cat([torch.ones(3), torch.exp(-0.5 * (frequencies * spread) ** 2)])


C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def coefficient_count(degree: int) -> int:
    """Number of coefficients up to a degree."""
    return (degree + 1) ** 2


def sh_degree(rest: Tensor) -> int:
    """Degree of (N, 3, K - 1) coefficients above degree 0."""
    return math.isqrt(rest.shape[2] + 1) - 1


def occupied_degree(rest: Tensor) -> int:
    """Highest degree of which (N, 3, K - 1) coefficients above degree 0 have any other than zero."""
    degree = sh_degree(rest)
    while degree and not rest[:, :, coefficient_count(degree - 1) - 1 :].any():
        degree -= 1
    return degree


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of unit directions, (N, (degree+1)^2).

    Order and signs are those of 3DGS: degree by degree, m from -l to l, with the Condon-Shortley phase kept
    (so the m = +-1 terms of degree 1 are -y and -x). Degrees above 3 are not stored by any tool of the field.
    """
    x, y, z = directions.unbind(1)
    terms = [torch.full_like(x, C0)]
    if degree >= 1:
        terms += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        terms += [C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * zz - xx - yy), -C2[0] * x * z]
        terms += [C2[2] * (xx - yy)]
    if degree >= 3:
        terms += [-C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, -C3[2] * y * (4 * zz - xx - yy)]
        terms += [C3[3] * z * (2 * zz - 3 * xx - 3 * yy), -C3[2] * x * (4 * zz - xx - yy)]
        terms += [C3[4] * z * (xx - yy), -C3[0] * x * (xx - 3 * yy)]
    return torch.stack(terms, dim=1)


def initial_coefficients(count: int, degree: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Coefficients to start training from, as 3DGS stores them: nearly zero at degree 0, zero above.

    Returns
    -------
    ``sh_dc`` (N, 3) and ``sh_rest`` (N, 3, K - 1), K the `coefficient_count` of ``degree``.
    """
    dc = torch.rand(count, 3, generator=generator) / 255
    return {"sh_dc": dc, "sh_rest": torch.zeros(count, 3, coefficient_count(degree) - 1)}


class _Weigh(torch.autograd.Function):
    """(N, 3, K) coefficients times (N, K) basis values; spares autograd's two passes over the coefficients."""

    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, basis: Tensor) -> Tensor:
        ctx.save_for_backward(coefficients, basis)
        return torch.bmm(coefficients, basis[:, :, None])[:, :, 0]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        coefficients, basis = ctx.saved_tensors
        gradient = grads[0]
        return gradient[:, :, None] * basis[:, None, :], torch.bmm(gradient[:, None, :], coefficients)[:, 0]


def sh_to_rgb(dc: Tensor, rest: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Colours (N, 3) >= 0 seen along unit directions (from the camera to the splat): relu(0.5 + SH).

    Parameters
    ----------
    dc : (N, 3) coefficient of degree 0.
    rest : (N, 3, 15) coefficients of degrees 1 to 3 by channel; those above ``degree`` are not used.
    """
    if degree == 0:
        return torch.relu(0.5 + C0 * dc)
    basis = sh_basis(directions, degree)[:, 1:].contiguous()
    view = _Weigh.apply(rest[:, :, : basis.shape[1]].contiguous(), basis)  # type: ignore[no-untyped-call]
    return torch.relu(0.5 + C0 * dc + view)
