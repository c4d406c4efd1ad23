"""Fit of spherical harmonics to view-dependent colours."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import FloatArray, HarmonicAvatar, HeadPose, SplatAvatar
from ..ops.harmonics import coefficient_count, sh_basis
from .views import camera_at, visibility

DEGREE = 3
FAR_M = 1e3
"""Distance of a camera that sees all splats along one direction."""
HIDDEN = 0.005
"""Minimum weight of a direction relative to the largest: a splat is hardly trained where it is hidden."""
BLOCK = 4096  # splats per batch of normal equations


class Harmonics(NamedTuple):
    """Coefficients in 3DGS order, and the error of the fit."""

    dc: Tensor
    """(N, 3)."""
    rest: Tensor
    """(N, 3, 15)."""
    residual: Tensor | None
    """(N,) root of the weighted mean squared error over directions and channels, in colour units; None if nothing was fitted."""


def harmonics_of(avatar: SplatAvatar, pose: HeadPose, directions: int) -> Harmonics:
    """Harmonics of an avatar's splats in a pose along world directions: its own, or harmonics fitted to its colours."""
    if isinstance(avatar, HarmonicAvatar):
        dc, rest = map(torch.from_numpy, avatar.harmonics(pose))
        return Harmonics(dc, rest, None)
    splats, along = avatar.splats(pose), sphere(directions)
    middle = splats.means.mean(axis=0)

    def radiance(direction: Tensor) -> Tensor:
        colors = avatar.splats(pose, camera_at(middle + FAR_M * direction.numpy())).colors
        assert colors is not None  # the camera is given
        return torch.from_numpy(np.asarray(colors, np.float32))

    return fit_harmonics(radiance, visibility(splats, along.numpy()), along)


def sphere(count: int) -> Tensor:
    """(count, 3) float32 unit vectors spread evenly: a Fibonacci lattice."""
    number = np.arange(count) + 0.5
    height = 1 - 2 * number / count
    radius, angle = np.sqrt(1 - height**2), np.pi * (1 + 5**0.5) * number
    points = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1)
    return torch.from_numpy(points.astype(np.float32))


def turn_harmonics(dc: Tensor, rest: Tensor, rotation: Tensor) -> tuple[FloatArray, FloatArray]:
    """Harmonics along world directions, (N, 3) and (N, 3, 15), of harmonics along the splats' own directions.

    A rotated harmonic is a sum of harmonics of its degree; it is found from as many directions as coefficients, exact
    to rounding.

    - ``dc``, ``rest``: (N, 3) and (N, 3, K - 1) in each splat's own axes, K up to 16.
    - ``rotation``: (N, 3, 3) from a splat's own axes to the world's.
    """
    dc, rest, rotation = dc.cpu(), rest.cpu(), rotation.cpu()
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
    return turned[:, :, 0].contiguous().numpy(), turned[:, :, 1:].contiguous().numpy()


def fit_harmonics(radiance: Callable[[Tensor], Tensor], weights: Tensor, directions: Tensor) -> Harmonics:
    """Weighted least squares for each splat over (M, 3) directions from the splat to the camera.

    - ``radiance``: maps one direction (3,) to the colours (N, 3) seen from it.
    - ``weights``: (N, M) weights of the directions, see `visibility`; at least `HIDDEN` is used.
    """
    # 3DGS evaluates harmonics along the direction from the camera to the splat.
    basis = sh_basis(-directions, DEGREE)
    colors = torch.stack([radiance(direction) for direction in directions], dim=1) - 0.5  # (N, M, 3)
    count = coefficient_count(DEGREE)
    coefficients = colors.new_empty(len(colors), count, 3)
    residual = colors.new_empty(len(colors))
    products = (basis[:, :, None] * basis[:, None, :]).flatten(1)
    for start in range(0, len(colors), BLOCK):
        rows = slice(start, start + BLOCK)
        part = weights[rows].clamp_min(HIDDEN)  # (n, M)
        # The coefficients are of order 1, and the weights add up to tens: 1e-6 only guards the solver.
        matrix = (part @ products).view(-1, count, count) + 1e-6 * torch.eye(count)
        right = torch.einsum("mk,nm,nmc->nkc", basis, part, colors[rows])
        coefficients[rows] = torch.linalg.solve(matrix, right)
        error = (torch.einsum("mk,nkc->nmc", basis, coefficients[rows]) - colors[rows]).square().mean(2)
        residual[rows] = ((part * error).sum(1) / part.sum(1)).sqrt()
    channels = coefficients.transpose(1, 2)
    return Harmonics(channels[:, :, 0].contiguous(), channels[:, :, 1:].contiguous(), residual)
