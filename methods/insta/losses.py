"""INSTA's losses per ray, section 3.4."""

from __future__ import annotations

import torch
from torch import Tensor

from ..shared.loop import recomposited
from .config import InstaConfig

COLOR_PART = 0.2  # the published program divides the Huber loss by 5


def color_loss(color: Tensor, truth: Tensor, weights: Tensor, huber: float) -> Tensor:
    """Weighted mean over (R,) rays of the Huber loss of (R, 3) colours: square below ``huber``, linear above.

    Channels are added up, as in the published program, which hands each its own gradient.
    """
    each = torch.nn.functional.huber_loss(color, truth, delta=huber, reduction="none") / huber
    return COLOR_PART * (weights * each.sum(1)).mean()


def depth_loss(distance: Tensor, truth: Tensor) -> Tensor:
    """Mean over (R,) rays of the distance, metres, between expected and true depth; rays without have infinity."""
    known = truth.isfinite()
    return (distance - torch.where(known, truth, distance.detach())).abs().mean()


def true_colors(
    image: Tensor, coverage: Tensor, recorded_on: Tensor, background: Tensor, config: InstaConfig
) -> Tensor:
    """Colours of (R, 3) pixels on another background than the one they were recorded on.

    Parameters
    ----------
    coverage : (R, 1) in [0, 1].
    """
    if config.target_compatibility == "code":
        own = (image - (1 - coverage) * recorded_on).clamp(0, 1) / coverage.clamp_min(1 / 255)
        mixed = coverage * to_linear(own.clamp(0, 1)) + (1 - coverage) * to_linear(background)
        return to_srgb(mixed)
    return recomposited(image, coverage, recorded_on, background)


def to_linear(srgb: Tensor) -> Tensor:
    """Linear light of display-referred sRGB (IEC 61966-2-1)."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Tensor) -> Tensor:
    """Inverse of `to_linear`."""
    bright = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, bright)
