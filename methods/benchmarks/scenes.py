"""Synthetic splats with the rendering load of a trained head avatar."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..ops.splats import left_products
from ..splats.rasterize import rasterize
from ..splats.request import Rendering


class SplatScene(NamedTuple):
    """The first nine arguments of `rasterize`, in order, and its background."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    background: Tensor


def head_shell(count: int, width: int, height: int, *, channels: int = 3, seed: int = 0) -> SplatScene:
    """Splats on an ellipsoid of a head's proportions, filling 62 % of the image height.

    Tangential sizes are log-normal about three quarters of the splats' spacing, a fifth of that thick; two fifths of
    the splats at the back and the top are stretched fourfold, as hair is. Many are nearly opaque, many faint.
    """
    rng = torch.Generator().manual_seed(seed)
    half_axes = torch.tensor([0.75, 1.0, 0.85]) * 0.12  # metres; y is up in the head, down in the image
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    means = direction * half_axes
    normals = torch.nn.functional.normalize(direction / half_axes, dim=1)

    area = 4 * math.pi * float(half_axes.prod() ** (2 / 3))
    spacing = math.sqrt(area / max(count, 1))
    size = 0.75 * spacing * torch.exp(0.55 * torch.randn(count, generator=rng))
    stretch = torch.exp(0.45 * torch.randn(count, generator=rng))
    hair = ((direction[:, 2] > 0.2) | (direction[:, 1] < -0.5)) & (torch.rand(count, generator=rng) < 0.4)
    stretch = torch.where(hair, 4 * stretch, stretch)
    scales = torch.stack([size * stretch.sqrt(), size / stretch.sqrt(), 0.2 * size], dim=1)

    # The third axis along the normal, the first turned at random about it; lengths of quaternions are arbitrary.
    tilt = torch.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], torch.zeros(count)], dim=1)
    half_turn = math.pi * torch.rand(count, generator=rng)
    spin = torch.stack([half_turn.cos(), *[torch.zeros(count)] * 2, half_turn.sin()], dim=1)
    quats = (left_products(tilt) @ spin[:, :, None])[:, :, 0] * (0.5 + torch.rand(count, 1, generator=rng))

    opacities = torch.sigmoid(0.4 + 1.8 * torch.randn(count, generator=rng))
    colors = torch.rand(count, channels, generator=rng)
    distance = 1.0
    focal = 0.62 * height * distance / (2 * float(half_axes[1]))
    K = torch.tensor([[focal, 0, 0.5 * width + 1.3], [0, focal, 0.5 * height - 2.1], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[2, 3] = distance
    background = torch.linspace(0.2, 0.9, channels)
    return SplatScene(means, quats, scales, opacities, colors, viewmat, K, width, height, background)


def cloud(
    count: int,
    width: int,
    height: int,
    *,
    channels: int = 3,
    seed: int = 0,
    size: float = 0.03,
    opacity: float = 0.0,
) -> SplatScene:
    """Splats of all shapes about the frustum of a camera with its principal point off centre.

    Some lie behind the camera and some far outside the image. ``size`` is the median scale in metres, ``opacity`` the
    median opacity as a logit.
    """
    rng = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=rng) * torch.tensor([0.5, 0.6, 0.9]) + torch.tensor(
        [0.0, 0.0, 1.6]
    )
    scales = size * torch.exp(torch.randn(count, 3, generator=rng))
    quats = torch.randn(count, 4, generator=rng)
    opacities = torch.sigmoid(opacity + 2 * torch.randn(count, generator=rng))
    colors = torch.randn(count, channels, generator=rng)
    # A slightly rotated and moved camera; its rotation is exact to float64 for any requested dtype.
    skew = 0.2 * torch.randn(3, 3, generator=rng, dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.linalg.matrix_exp(skew - skew.T)
    viewmat[:3, 3] = 0.1 * torch.randn(3, generator=rng, dtype=torch.float64)
    focal = 1.1 * max(width, height)
    K = torch.tensor([[focal, 0, 0.31 * width], [0, 0.9 * focal, 0.72 * height], [0, 0, 1]])
    background = torch.rand(channels, generator=rng)
    return SplatScene(means, quats, scales, opacities, colors, viewmat.float(), K, width, height, background)


DIFFERENTIABLE = (
    *("means", "quats", "scales", "opacities", "colors", "viewmat", "K"),
    *("background", "means2d_offset"),
)


class DrawnScene(NamedTuple):
    """A rendering and the gradients of all inputs, by name."""

    rendering: Rendering
    gradients: dict[str, Tensor]


def render_with_gradients(
    scene: SplatScene, dtype: torch.dtype, *, weights: Tensor | None = None, seed: int = 0, **options: Any
) -> DrawnScene:
    """Render in ``dtype`` and differentiate a random linear function of image and alpha.

    ``weights`` (H, W) scale it per pixel.
    """
    zeros = torch.zeros(len(scene.means), 2)
    values = {**scene._asdict(), "means2d_offset": zeros}
    leaves = {name: values[name].detach().to(dtype).clone().requires_grad_() for name in DIFFERENTIABLE}
    result = rasterize(**leaves, width=scene.width, height=scene.height, **options)
    rng = torch.Generator().manual_seed(seed)
    on_image = torch.randn(result.image.shape, generator=rng).to(dtype)
    on_alpha = torch.randn(result.alpha.shape, generator=rng).to(dtype)
    if weights is not None:
        on_image, on_alpha = on_image * weights[..., None], on_alpha * weights
    gradients = torch.autograd.grad((result.image, result.alpha), list(leaves.values()), (on_image, on_alpha))
    detached = replace(result, image=result.image.detach(), alpha=result.alpha.detach())
    return DrawnScene(detached, dict(zip(leaves, gradients, strict=True)))


def relative_error(value: Tensor, truth: Tensor) -> float:
    """Norm of the difference over the norm of the truth; the difference alone where the truth is zero."""
    difference, norm = float((value.double() - truth.double()).norm()), float(truth.double().norm())
    return difference / norm if norm else difference
