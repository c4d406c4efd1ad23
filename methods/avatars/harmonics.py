"""Views of an avatar, and the fit of spherical harmonics to view-dependent colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Camera, Clip, FloatArray, HarmonicAvatar, HeadPose, SplatAvatar, Splats
from ...bench.protocol import evenly_with_ends
from ..ops.planes import coefficient_count, sh_basis
from ..ops.splats import WorldSplats
from ..shared.rendering import pixel_sums, view_of

FIELD_OF_VIEW = 30.0
"""Field of view of the cameras of `orbit_camera`, degrees."""
SIZE = 128
"""Image size of `visibility`, pixels."""


def extent(means: FloatArray) -> FloatArray:
    """(2, 3) lowest and highest coordinates of (N, 3) splats, without the outermost 1 %."""
    return np.asarray(np.quantile(means, (0.005, 0.995), axis=0))


def contribution(splats: Splats, camera: Camera) -> Tensor:
    """(N,) blending weights of each splat, summed over all pixels of one view, see `pixel_sums`.

    Used as importance for pruning by Fang and Wang, "Mini-Splatting", ECCV 2024, section 4.
    """
    return _sums(splats, camera, torch.ones(camera.height, camera.width, 1))[:, 0]


def _sums(splats: Splats, camera: Camera, targets: Tensor) -> Tensor:
    geometry = splats.means, splats.quats, splats.scales, splats.opacities
    *world, opacities = (torch.tensor(np.asarray(values, np.float32)) for values in geometry)
    return pixel_sums(WorldSplats(*world), opacities, view_of(camera, "cpu"), targets)


VIEWS = 64


def training_views(clip: Clip, count: int = VIEWS) -> list[tuple[Camera, HeadPose]]:
    """At most ``count`` training frames, evenly spread over their sorted keys."""
    keys = evenly_with_ends(sorted(clip.splits["train"]), count)
    return [(clip.cameras[key.camera], clip.poses[key.timestep]) for key in keys]


def squared_contribution(splats: Splats, camera: Camera, generator: torch.Generator) -> Tensor:
    """(N,) squared blending weights of each splat, summed over all pixels of one view and divided by their number.

    This is the mean squared error of the picture per unit of squared error of the splat's colour. It is estimated from
    derivatives of sums of pixels with random signs, since all other products of weights have the expectation 0 (M.
    Hutchinson, Communications in Statistics 18, 1989); three channels are three draws.
    """
    signs = 2.0 * torch.randint(0, 2, (camera.height, camera.width, 3), generator=generator) - 1.0
    weights = _sums(splats, camera, signs)
    return (weights**2).mean(1) / (camera.width * camera.height)


def importance(avatar: SplatAvatar, views: Sequence[tuple[Camera, HeadPose]]) -> FloatArray:
    """(N,) mean of `squared_contribution` over views; equal calls give equal numbers."""
    generator = torch.Generator().manual_seed(0)
    weights = [squared_contribution(avatar.splats(pose), camera, generator) for camera, pose in views]
    return torch.stack(weights).mean(0).numpy().astype(np.float64)


def visibility(splats: Splats, directions: FloatArray) -> Tensor:
    """(N, M) visibility of each splat from (M, 3) unit vectors to the camera, relative to its maximum."""
    middle = splats.means.mean(axis=0)
    radius = float(np.quantile(np.linalg.norm(splats.means - middle, axis=1), 0.99))
    distance = max(radius, 1e-3) / np.tan(np.radians(FIELD_OF_VIEW / 2))
    weights = torch.stack(
        [contribution(splats, orbit_camera(d, distance, middle, SIZE)) for d in directions], dim=1
    )
    return weights / weights.amax(dim=1, keepdim=True).clamp_min(1e-6)


def direction_of(azimuth: float, elevation: float) -> FloatArray:
    """(3,) unit vector to a camera at angles in radians, 0 from the front."""
    around = np.cos(elevation)
    return np.array([np.sin(azimuth) * around, np.sin(elevation), np.cos(azimuth) * around])


def camera_at(place: FloatArray) -> Camera:
    """A camera of which only the position is used, (3,) metres."""
    motion = np.eye(4)
    motion[:3, 3] = -np.asarray(place, np.float64)
    return Camera("place", 8, 8, np.eye(3), motion)


def orbit_camera(direction: FloatArray, distance: float, target: FloatArray, size: int) -> Camera:
    """An upright square view of a target; (3,) unit vector to the camera, not vertical."""
    ahead = -np.asarray(direction, np.float64)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    motion = np.eye(4)
    motion[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
    motion[:3, 3] = -motion[:3, :3] @ (target - distance * ahead)
    focal = size / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Camera("view", size, size, K, motion)


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
    coefficients = torch.zeros(len(dc), 3, count, dtype=dc.dtype)
    coefficients[:, :, 0], coefficients[:, :, 1 : 1 + rest.shape[2]] = dc, rest
    turned = torch.empty_like(coefficients)
    for start in range(0, len(dc), BLOCK):
        rows = slice(start, start + BLOCK)
        along = directions @ rotation[rows]  # (n, M, 3) the directions in the splats' own axes
        basis = sh_basis(along.reshape(-1, 3), DEGREE).view(len(along), -1, count)
        turned[rows] = (coefficients[rows] @ basis.transpose(1, 2) @ solve.to(dc.dtype).t()).to(dc.dtype)
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
