"""Losses of splat training: L1 with SSIM, and the two regularisers of GaussianAvatars; quality of 8-bit pictures."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ...bench.contracts import ByteArray

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


@lru_cache(maxsize=16)
def window_weights(dtype: torch.dtype = torch.float32, device: str = "cpu") -> Tensor:
    """(11,) weights of SSIM's window along one axis, of sum 1."""
    offset = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weights = torch.exp(-(offset**2) / (2 * SIGMA**2))
    return (weights / weights.sum()).to(device=device, dtype=dtype)


@lru_cache(maxsize=16)
def _window(channels: int, dtype: torch.dtype, device: str) -> tuple[Tensor, Tensor]:
    weights = window_weights(dtype, device)
    column = weights.view(1, 1, WINDOW, 1).repeat(channels, 1, 1, 1)
    row = weights.view(1, 1, 1, WINDOW).repeat(channels, 1, 1, 1)
    return column, row


def blur(planes: Tensor) -> Tensor:
    """Gaussian window of SSIM (11 x 11, sigma 1.5) over (C, H, W), zeros outside. It is its own adjoint."""
    column, row = _window(planes.shape[0], planes.dtype, str(planes.device))
    half = WINDOW // 2
    vertical = F.conv2d(planes[None], column, padding=(half, 0), groups=planes.shape[0])
    return F.conv2d(vertical, row, padding=(0, half), groups=planes.shape[0])[0]


class _MeanSSIM(torch.autograd.Function):
    """Mean SSIM with its gradient in closed form: three blurs forward and three back, no graph of small ops."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, truth: Tensor) -> Tensor:
        channels = image.shape[0]
        blurred = blur(torch.cat([image, image * image, image * truth, truth, truth * truth]))
        mean_x, xx, xy, mean_y, yy = blurred.split(channels)
        mean_product = mean_x * mean_y
        luminance_top = 2 * mean_product + C1
        structure_top = 2 * (xy - mean_product) + C2
        squares = mean_x * mean_x + mean_y * mean_y
        luminance_bottom = squares + C1
        structure_bottom = (xx + yy - squares) + C2
        inverse = 1 / (luminance_bottom * structure_bottom)
        ssim = luminance_top * structure_top * inverse
        if image.requires_grad:
            # Derivatives of SSIM by the three blurred planes that contain the image: E[x], E[x^2], E[xy].
            by_xx = -ssim / structure_bottom
            by_xy = 2 * luminance_top * inverse
            by_mean = (
                2 * mean_y * (structure_top - luminance_top) * inverse
                - 2 * mean_x * ssim / luminance_bottom
                + 2 * mean_x * ssim / structure_bottom
            )
            ctx.save_for_backward(image, truth, by_mean, by_xx, by_xy)
        return ssim.mean()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        image, truth, by_mean, by_xx, by_xy = ctx.saved_tensors
        at_mean, at_xx, at_xy = blur(torch.cat([by_mean, by_xx, by_xy])).split(image.shape[0])
        gradient = at_mean + 2 * image * at_xx + truth * at_xy
        return gradient * (grads[0] / image.numel()), None


def mean_ssim(image: Tensor, truth: Tensor) -> Tensor:
    """SSIM as 3DGS trains with: 11 x 11 Gaussian window of sigma 1.5, zero padding, mean over all pixels.

    Parameters
    ----------
    image, truth : (3, H, W) in [0, 1]; only ``image`` receives a gradient.

    Wang et al. 2004, eq. 13 with population moments. Not an evaluation metric: the zero padding lowers borders.
    """
    return _MeanSSIM.apply(image, truth)  # type: ignore[no-untyped-call]


def photometric_loss(image: Tensor, truth: Tensor, ssim_weight: float) -> Tensor:
    """``(1 - w) mean|image - truth| + w (1 - SSIM)`` of two (H, W, 3) images in [0, 1]; 3DGS, eq. 7."""
    loss = (1 - ssim_weight) * (image - truth).abs().mean()
    if ssim_weight:
        ssim = mean_ssim(image.permute(2, 0, 1).contiguous(), truth.permute(2, 0, 1).contiguous())
        loss = loss + ssim_weight * (1 - ssim)
    return loss


def squared_error(picture: ByteArray, truth: ByteArray) -> float:
    """Mean squared difference of two 8-bit pictures, in levels squared."""
    return float(np.mean((picture.astype(np.float64) - truth) ** 2))


def psnr(error: float) -> float:
    """PSNR, dB, of a mean squared difference of 8-bit pictures; infinite at 0."""
    return math.inf if error == 0 else 10 * math.log10(255**2 / error)


def picture_ssim(picture: ByteArray, truth: ByteArray) -> float:
    """`mean_ssim` of two (H, W, 3) 8-bit pictures."""
    planes = [torch.from_numpy(image.astype(np.float32) / 255).permute(2, 0, 1) for image in (picture, truth)]
    return float(mean_ssim(*(image.contiguous() for image in planes)))


def mean_over_visible(values: Tensor, visible: Tensor) -> Tensor:
    """Mean of (N,) values where (N,) ``visible`` is true; 0 where nothing is."""
    weight = visible.to(values.dtype)
    return (values * weight).sum() / weight.sum().clamp_min(1)


def position_penalty(means: Tensor, visible: Tensor, threshold: float) -> Tensor:
    """Mean over visible splats of how far (N, 3) local positions reach beyond the threshold (triangle sizes)."""
    return mean_over_visible(F.relu(torch.linalg.vector_norm(means, dim=1) - threshold), visible)


def scale_penalty(log_scales: Tensor, visible: Tensor, threshold: float) -> Tensor:
    """Mean over visible splats of the norm of (N, 3) local scales' excess over the threshold.

    The norm's gradient at zero is taken as 0.
    """
    excess = F.relu(log_scales.exp() - threshold)
    return mean_over_visible(torch.linalg.vector_norm(excess, dim=1), visible)
