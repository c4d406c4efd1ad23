"""Structural similarity of one frame: the canonical form, which is one of several in use.

Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment: from error visibility to structural similarity",
IEEE TIP 2004, equation 13 with K1 = 0.01, K2 = 0.03 and L = 255, under the paper's window: an 11 x 11 Gaussian
of standard deviation 1.5, weights summing to one. Only windows that lie wholly inside the image count
("valid"); channels are compared one by one, then all are averaged. This equals scikit-image with
``gaussian_weights=True, sigma=1.5, use_sample_covariance=False``; it differs from torchmetrics since 1.4.2
(reflected border), from the training loss of 3D Gaussian splatting (zero border), and from scikit-image's
default (7 x 7 uniform window).
"""

from __future__ import annotations

import cv2
import numpy as np

from ..bench.contracts import ByteArray, FloatArray
from .pairs import check_pair

RADIUS = 5
SIGMA = 1.5
C1, C2 = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2


def gaussian_window() -> FloatArray:
    """(11,) float64 weights of the separable window; they sum to one."""
    offsets = np.arange(-RADIUS, RADIUS + 1, dtype=np.float64)
    weights = np.exp(-0.5 * (offsets / SIGMA) ** 2)
    return weights / weights.sum()


def ssim_map(image: ByteArray, truth: ByteArray) -> FloatArray:
    """(H - 10, W - 10, 3) float64 local similarity of two (H, W, 3) 8-bit images, at most 1.

    Entry (i, j) belongs to the window centred on pixel (i + 5, j + 5).
    """
    check_pair(image, truth, smallest=2 * RADIUS + 1)
    window = gaussian_window()

    def blur(values: FloatArray) -> FloatArray:
        blurred = cv2.sepFilter2D(values, cv2.CV_64F, window, window, borderType=cv2.BORDER_REFLECT)
        return np.asarray(blurred[RADIUS:-RADIUS, RADIUS:-RADIUS], dtype=np.float64)

    # Only the sum of the two variances enters the formula, so four filters do instead of five.
    x, y = image.astype(np.float64), truth.astype(np.float64)
    mean_x, mean_y = blur(x), blur(y)
    mean_product = mean_x * mean_y
    mean_squares = mean_x * mean_x + mean_y * mean_y
    covariance = blur(x * y) - mean_product
    variances = blur(x * x + y * y) - mean_squares
    numerator = (2.0 * mean_product + C1) * (2.0 * covariance + C2)
    return numerator / ((mean_squares + C1) * (variances + C2))


def ssim(image: ByteArray, truth: ByteArray) -> float:
    """Mean of `ssim_map` over windows and channels, in [-1, 1]; 1 for identical images."""
    return float(ssim_map(image, truth).mean())
