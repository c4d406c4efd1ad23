"""Regularisers of GaussianAvatars, and quality of 8-bit images."""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ...bench.contracts import ByteArray
from ..ops.photometric import mean_ssim


def squared_error(picture: ByteArray, truth: ByteArray) -> float:
    """Mean squared difference of two 8-bit images, in squared levels."""
    return float(np.mean((picture.astype(np.float64) - truth) ** 2))


def psnr(error: float) -> float:
    """PSNR in dB for a mean squared difference of 8-bit images; infinite for 0."""
    return math.inf if error == 0 else 10 * math.log10(255**2 / error)


def picture_ssim(picture: ByteArray, truth: ByteArray) -> float:
    """`mean_ssim` of two (H, W, 3) 8-bit images."""
    planes = [torch.from_numpy(image.astype(np.float32) / 255).permute(2, 0, 1) for image in (picture, truth)]
    return float(mean_ssim(*(image.contiguous() for image in planes)))


def mean_over_visible(values: Tensor, visible: Tensor) -> Tensor:
    """Mean of (N,) values where (N,) ``visible`` is true; 0 if there are none."""
    weight = visible.to(values.dtype)
    return (values * weight).sum() / weight.sum().clamp_min(1)


def position_penalty(means: Tensor, visible: Tensor, threshold: float) -> Tensor:
    """Mean over visible splats of the excess of (N, 3) local positions over the threshold (triangle sizes)."""
    return mean_over_visible(F.relu(torch.linalg.vector_norm(means, dim=1) - threshold), visible)


def scale_penalty(log_scales: Tensor, visible: Tensor, threshold: float) -> Tensor:
    """Mean over visible splats of the norm of (N, 3) local scales' excess over the threshold.

    The norm's gradient at zero is taken as 0.
    """
    excess = F.relu(log_scales.exp() - threshold)
    return mean_over_visible(torch.linalg.vector_norm(excess, dim=1), visible)
