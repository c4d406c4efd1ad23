"""Colours by real spherical harmonics."""

from __future__ import annotations

import math
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import normalize, pad

from ...bench.native.dispatch import Operation
from .kernel import KERNEL, call, empty_like
from .splats import apply_matrices

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
    """Highest degree with non-zero coefficients among (N, 3, K - 1) above degree 0."""
    degree = sh_degree(rest)
    while degree and not rest[:, :, coefficient_count(degree - 1) - 1 :].any():
        degree -= 1
    return degree


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of unit directions, (N, (degree+1)^2).

    Order and signs are those of 3DGS: degree by degree, m from -l to l, with the Condon-Shortley phase kept
    (so the m = +-1 terms of degree 1 are -y and -x). No common tool stores degrees above 3.
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

    Returns ``sh_dc`` (N, 3) and ``sh_rest`` (N, 3, K - 1), K the `coefficient_count` of ``degree``.
    """
    dc = torch.rand(count, 3, generator=generator) / 255
    return {"sh_dc": dc, "sh_rest": torch.zeros(count, 3, coefficient_count(degree) - 1)}


@Operation
def harmonic_colors(dc: Tensor, rest: Tensor, vectors: Tensor, degree: int) -> Tensor:
    """Colours (N, 3) >= 0 seen along vectors from the camera to the splats, of any length: relu(0.5 + SH).

    - ``dc``: (N, 3) coefficient of degree 0.
    - ``rest``: (N, 3, K - 1) coefficients of higher degrees by channel; those above ``degree`` are not used.
    """
    if degree == 0:
        return torch.relu(0.5 + C0 * dc)
    basis = sh_basis(normalize(vectors, dim=1), degree)[:, 1:, None]
    view = torch.bmm(rest[:, :, : basis.shape[1]], basis)[:, :, 0]
    return torch.relu(0.5 + C0 * dc + view)


@harmonic_colors.compiled(KERNEL)
def _harmonic_colors(dc: Tensor, rest: Tensor, vectors: Tensor, degree: int) -> Tensor:
    return _HarmonicColors.apply(dc, rest, vectors, degree)  # type: ignore[no-untyped-call]


class _HarmonicColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dc: Tensor, rest: Tensor, vectors: Tensor, degree: int) -> Tensor:
        colors = empty_like(dc)
        call("harmonics", degree, dc, rest, vectors, colors)
        ctx.save_for_backward(dc, rest, vectors, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        dc, rest, vectors, colors = ctx.saved_tensors
        gradients = empty_like(dc), empty_like(rest), empty_like(vectors)
        call("harmonics_backward", ctx.degree, dc, rest, vectors, colors, grad, *gradients)
        return *gradients, None


def turned_colors(
    dc: Tensor, rest: Tensor, means: Tensor, rotation: Tensor, center: Tensor, degree: int
) -> Tensor:
    """`harmonic_colors` along the axes of each splat, (N, 3, 3) from these to the world, seen from a camera at ``center`` (3,)."""
    along = torch.bmm((means - center)[:, None], rotation)[:, 0]
    return harmonic_colors(dc, rest, along, degree)


class HarmonicShader(Protocol):
    """Colours by constant spherical harmonics for any number of views, without gradients."""

    def __call__(
        self, means: Tensor, center: Tensor, turns: Tensor | None = None, binding: Tensor | None = None
    ) -> Tensor:
        """Colours (N, 3) >= 0 of splats at (N, 3) means for a camera at ``center``.

        ``turns`` (F, 3, 3) rotate the directions of the splats on each triangle, given by ``binding`` (N,).
        """


@Operation
def harmonic_shader(dc: Tensor, rest: Tensor) -> HarmonicShader:
    """`harmonic_colors` of (N, 3) and (N, 3, K - 1) coefficients, all of which are used."""

    def shade(
        means: Tensor, center: Tensor, turns: Tensor | None = None, binding: Tensor | None = None
    ) -> Tensor:
        vectors = means - center
        if turns is not None and binding is not None:
            vectors = apply_matrices(turns.reshape(-1, 9).index_select(0, binding), vectors)
        return harmonic_colors(dc, rest, vectors, sh_degree(rest))

    return shade


HARMONICS_BLOCK = 16
"""Number of splats whose coefficients are stored side by side."""


@harmonic_shader.compiled(KERNEL)
def _harmonic_shader(dc: Tensor, rest: Tensor) -> HarmonicShader:
    whole = torch.cat([dc[:, :, None], rest], dim=2)
    blocks = -(-len(whole) // HARMONICS_BLOCK)
    padded = pad(whole, (0, 0, 0, 0, 0, blocks * HARMONICS_BLOCK - len(whole)))
    packed = padded.view(blocks, HARMONICS_BLOCK, *whole.shape[1:]).permute(0, 2, 3, 1).contiguous()

    def shade(
        means: Tensor, center: Tensor, turns: Tensor | None = None, binding: Tensor | None = None
    ) -> Tensor:
        colors = empty_like(means)
        call("shade", packed, means, turns, binding, center, colors)
        return colors

    return shade
