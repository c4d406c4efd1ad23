"""The photometric loss of splat training: L1 with structural similarity."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...bench.native.dispatch import Operation, to_device
from .kernel import KERNEL, call, empty_like

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


@lru_cache(maxsize=16)
def window_weights(dtype: torch.dtype = torch.float32, device: str = "cpu") -> Tensor:
    """(11,) weights of SSIM's window along one axis, of sum 1."""
    offset = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weights = torch.exp(-(offset**2) / (2 * SIGMA**2))
    on_device: Tensor = to_device((weights / weights.sum()).to(dtype), device)
    return on_device


def blur(planes: Tensor) -> Tensor:
    """Gaussian window of SSIM (11 x 11, sigma 1.5) over (C, H, W), zeros outside."""
    weights, channels, half = (window_weights(planes.dtype, str(planes.device)), len(planes), WINDOW // 2)
    column, row = weights.view(1, 1, WINDOW, 1), weights.view(1, 1, 1, WINDOW)
    vertical = F.conv2d(planes[None], column.expand(channels, -1, -1, -1), padding=(half, 0), groups=channels)
    return F.conv2d(vertical, row.expand(channels, -1, -1, -1), padding=(0, half), groups=channels)[0]


def mean_ssim(image: Tensor, truth: Tensor) -> Tensor:
    """SSIM as in the training of 3DGS: 11 x 11 Gaussian window of sigma 1.5, zero padding, mean over all pixels.

    Wang et al. 2004, eq. 13 with population moments. This is not an evaluation metric: the zero padding lowers values
    at borders.

    ``image``, ``truth``: (3, H, W) in [0, 1].
    """
    blurred = blur(torch.cat([image, truth, image * image + truth * truth, image * truth]))
    mean_x, mean_y, squares, products = blurred.split(len(image))
    mean_product, mean_squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    top = (2 * mean_product + C1) * (2 * (products - mean_product) + C2)
    bottom = (mean_squares + C1) * ((squares - mean_squares) + C2)
    return (top / bottom).mean()


@Operation
def photometric_loss(image: Tensor, truth: Tensor, ssim_weight: float) -> Tensor:
    """``(1 - w) mean|image - truth| + w (1 - SSIM)`` of two (H, W, 3) images in [0, 1]; 3DGS, eq. 7.

    In the compiled form, only ``image`` receives a gradient.
    """
    loss = (1 - ssim_weight) * (image - truth).abs().mean()
    if ssim_weight:
        loss = loss + ssim_weight * (1 - mean_ssim(image.permute(2, 0, 1), truth.permute(2, 0, 1)))
    return loss


@photometric_loss.compiled(KERNEL)
def _photometric_loss(image: Tensor, truth: Tensor, ssim_weight: float) -> Tensor:
    return _Photometric.apply(image, truth, ssim_weight)  # type: ignore[no-untyped-call]


class _Photometric(torch.autograd.Function):
    """Loss and gradient are computed in one pass over the image."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, truth: Tensor, ssim_weight: float) -> Tensor:
        gradient = empty_like(image)
        loss = call("photometric", image, truth, window_weights(), float(ssim_weight), gradient)
        ctx.save_for_backward(gradient)
        return image.new_tensor(loss)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return (gradient if grad == 1 else gradient * grad), None, None
