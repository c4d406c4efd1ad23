"""Real spherical harmonics up to degree 3, as 3DGS stores colour with them."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

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
