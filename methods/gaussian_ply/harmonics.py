"""Spherical harmonics that come closest to colours known by direction."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..ops.harmonics import coefficient_count, sh_basis

DEGREE = 3
BEHIND = 0.02
"""Weight of directions from behind a splat's triangle, from which it is hardly seen and was hardly trained."""
BLOCK = 4096  # splats whose normal equations are solved at once


class HarmonicsFit(NamedTuple):
    """Coefficients in 3DGS' order, and how well they fit."""

    dc: Tensor
    """(N, 3)."""
    rest: Tensor
    """(N, 3, 15)."""
    residual: Tensor
    """(N,) root of the weighted mean squared error over directions and channels, in colour units."""


def sphere(count: int) -> Tensor:
    """(count, 3) float32 unit vectors spread evenly: a Fibonacci lattice."""
    number = np.arange(count) + 0.5
    height = 1 - 2 * number / count
    radius, angle = np.sqrt(1 - height**2), np.pi * (1 + 5**0.5) * number
    points = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1)
    return torch.from_numpy(points.astype(np.float32))


def turn_harmonics(dc: Tensor, rest: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Harmonics along world directions, (N, 3) and (N, 3, 15), of harmonics along the splats' own directions.

    A turned harmonic is a sum of those of its degree: found from as many directions as decide it, exact to rounding.

    Parameters
    ----------
    dc, rest : (N, 3) and (N, 3, K - 1) along own directions, K up to 16.
    rotation : (N, 3, 3) from a splat's own axes to the world's.
    """
    count = coefficient_count(DEGREE)
    directions = sphere(4 * count).to(dc.dtype)
    solve = torch.linalg.pinv(sh_basis(directions, DEGREE).double())
    own = torch.zeros(len(dc), 3, count, dtype=dc.dtype)
    own[:, :, 0], own[:, :, 1 : 1 + rest.shape[2]] = dc, rest
    turned = torch.empty_like(own)
    for start in range(0, len(dc), BLOCK):
        rows = slice(start, start + BLOCK)
        along = directions @ rotation[rows]  # (n, M, 3) the directions in the splats' own axes
        basis = sh_basis(along.reshape(-1, 3), DEGREE).view(len(along), -1, count)
        turned[rows] = (own[rows] @ basis.transpose(1, 2) @ solve.to(dc.dtype).t()).to(dc.dtype)
    return turned[:, :, 0].contiguous(), turned[:, :, 1:].contiguous()


def fit_harmonics(radiance: Callable[[Tensor], Tensor], normals: Tensor, directions: Tensor) -> HarmonicsFit:
    """Weighted least squares for each splat over (M, 3) directions from the splat to the camera.

    Parameters
    ----------
    radiance : maps one direction (3,) to the colours (N, 3) seen from there.
    normals : (N, 3) unit vectors out of the surface; directions against them weigh `BEHIND`.
    """
    # 3DGS looks harmonics up along the way from the camera to the splat.
    basis = sh_basis(-directions, DEGREE)
    colors = torch.stack([radiance(direction) for direction in directions], dim=1) - 0.5  # (N, M, 3)
    count = coefficient_count(DEGREE)
    coefficients = colors.new_empty(len(colors), count, 3)
    residual = colors.new_empty(len(colors))
    products = (basis[:, :, None] * basis[:, None, :]).flatten(1)
    for start in range(0, len(colors), BLOCK):
        rows = slice(start, start + BLOCK)
        weights = torch.where(normals[rows] @ directions.t() > 0, 1.0, BEHIND)  # (n, M)
        # The coefficients are of order 1, and the weights add up to tens: 1e-6 only guards the solver.
        matrix = (weights @ products).view(-1, count, count) + 1e-6 * torch.eye(count)
        right = torch.einsum("mk,nm,nmc->nkc", basis, weights, colors[rows])
        coefficients[rows] = torch.linalg.solve(matrix, right)
        error = (torch.einsum("mk,nkc->nmc", basis, coefficients[rows]) - colors[rows]).square().mean(2)
        residual[rows] = ((weights * error).sum(1) / weights.sum(1)).sqrt()
    channels = coefficients.transpose(1, 2)
    return HarmonicsFit(channels[:, :, 0].contiguous(), channels[:, :, 1:].contiguous(), residual)
