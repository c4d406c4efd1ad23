"""Rendering a scene with gradients, and comparing two outcomes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ....methods.splats.rasterize import rasterize
from ....methods.splats.request import Rendering
from .scenes import Scene

DIFFERENTIABLE = (
    "means",
    "quats",
    "scales",
    "opacities",
    "colors",
    "viewmat",
    "K",
    "background",
    "means2d_offset",
    "means2d_abs",
)


class Outcome(NamedTuple):
    """A rendering and the gradients of all inputs, by name."""

    rendering: Rendering
    gradients: dict[str, Tensor]


def render_with_gradients(
    scene: Scene, dtype: torch.dtype, *, weights: Tensor | None = None, seed: int = 0, **options: Any
) -> Outcome:
    """Render in ``dtype`` and differentiate a random linear function of image and alpha.

    ``weights`` (H, W) scale it per pixel.
    """
    zeros = torch.zeros(*scene.viewmat.shape[:-2], len(scene.means), 2)
    values = {**scene._asdict(), "means2d_offset": zeros, "means2d_abs": zeros}
    leaves = {name: values[name].detach().to(dtype).clone().requires_grad_() for name in DIFFERENTIABLE}
    result = rasterize(
        leaves["means"],
        leaves["quats"],
        leaves["scales"],
        leaves["opacities"],
        leaves["colors"],
        leaves["viewmat"],
        leaves["K"],
        scene.width,
        scene.height,
        background=leaves["background"],
        means2d_offset=leaves["means2d_offset"],
        means2d_abs=leaves["means2d_abs"],
        **options,
    )
    rng = torch.Generator().manual_seed(seed)
    on_image = torch.randn(result.image.shape, generator=rng).to(dtype)
    on_alpha = torch.randn(result.alpha.shape, generator=rng).to(dtype)
    if weights is not None:
        on_image, on_alpha = on_image * weights[..., None], on_alpha * weights
    gradients = torch.autograd.grad((result.image, result.alpha), list(leaves.values()), (on_image, on_alpha))
    detached = replace(result, image=result.image.detach(), alpha=result.alpha.detach())
    return Outcome(detached, dict(zip(leaves, gradients, strict=True)))


def relative_error(value: Tensor, truth: Tensor) -> float:
    """Norm of the difference over the norm of the truth; the difference alone where the truth is zero."""
    difference, norm = float((value.double() - truth.double()).norm()), float(truth.double().norm())
    return difference / norm if norm else difference
