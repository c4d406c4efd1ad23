"""Structural similarity of one frame, in its common variants, which give different values for the same images.

Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment: from error visibility to structural similarity",
IEEE TIP 2004, equation 13 with K1 = 0.01, K2 = 0.03 and L = 255. Channels are compared one by one, then all are
averaged. Libraries differ in the window and in the treatment of the border, see `SsimForm`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from ..bench.contracts import ByteArray, FloatArray
from ..bench.specs import MetricSpec
from .psnr import Mask, check_masks, check_pair

SSIM = MetricSpec(
    name="ssim",
    label="SSIM",
    unit="",
    higher_is_better=True,
    digits=4,
    implementation="headbench.metrics.ssim:ssim",
    summary="Structural similarity, Gaussian window 11 x 11 of sigma 1.5, valid windows, mean over channels.",
    kind="regional",
    default=True,
)

C1, C2 = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2

Border = Literal["valid", "reflect", "zero"]


@dataclass(frozen=True)
class SsimForm:
    """Differences between implementations of SSIM."""

    window: Literal["gaussian", "uniform"] = "gaussian"
    """"gaussian", 11 x 11 with standard deviation 1.5 and weights that sum to one; or "uniform", 7 x 7."""
    border: Border = "valid"
    """"valid" uses only windows entirely inside the image; "reflect" (mirror about the outermost pixels) and "zero" (black) pad
    the image and use a window for every pixel."""
    sample_covariance: bool = False
    """Whether to use the sample variances and covariance, n / (n - 1) times those of the window."""
    downsample: bool = False
    """Whether to average blocks of ``round(min(H, W) / 256)`` pixels a side first (Wang's suggestion for large images), if that
    is more than one."""

    @cached_property
    def weights(self) -> FloatArray:
        """(2 radius + 1,) float64 weights of the separable window; they sum to one."""
        if self.window == "uniform":
            return np.full(7, 1 / 7)
        offsets = np.arange(-5, 6, dtype=np.float64)
        weights = np.exp(-0.5 * (offsets / 1.5) ** 2)
        return weights / weights.sum()

    @property
    def radius(self) -> int:
        """Pixels from the window's centre to its edge."""
        return len(self.weights) // 2

    @property
    def covariance_scale(self) -> float:
        """Factor of variances and covariance."""
        count = len(self.weights) ** 2
        return count / (count - 1) if self.sample_covariance else 1.0

    @property
    def smallest(self) -> int:
        """Minimum height and width in pixels."""
        return {"valid": 2 * self.radius + 1, "reflect": self.radius + 1, "zero": 1}[self.border]

    @property
    def inset(self) -> int:
        """Width of the border, in pixels, without window centres."""
        return self.radius if self.border == "valid" else 0


@dataclass(frozen=True)
class Ssim:
    """SSIM of 8-bit images: mean of `ssim_map`, in [-1, 1]; 1 for identical images."""

    form: SsimForm = SsimForm()

    def __call__(self, image: ByteArray, target: ByteArray) -> float:
        """Mean over all windows of two (H, W, 3) images."""
        return float(ssim_map(image, target, self.form).mean())

    def in_regions(self, image: ByteArray, target: ByteArray, masks: Mapping[str, Mask]) -> dict[str, float]:
        """Mean over the windows centred in each (H, W) boolean mask; regions without windows are left out."""
        check_pair(image, target, self.form.smallest)
        check_masks(masks, target)
        inset, blocks = self.form.inset, _blocks(self.form, target)
        local = ssim_map(image, target, self.form).mean(axis=2)
        inside = {name: _block_means(mask, blocks) >= 0.5 for name, mask in masks.items()}
        centres = {
            name: mask[inset : mask.shape[0] - inset, inset : mask.shape[1] - inset]
            for name, mask in inside.items()
        }
        return {name: float(local[mask].mean()) for name, mask in centres.items() if mask.any()}


def ssim_map(image: ByteArray, target: ByteArray, form: SsimForm = SsimForm()) -> FloatArray:
    """(H', W', 3) float64 local similarity of two (H, W, 3) 8-bit images, at most 1.

    For the border "valid" H' = H - 2 radius, and entry (i, j) belongs to the window centred on pixel (i + radius,
    j + radius); otherwise there is an entry for every pixel.
    """
    check_pair(image, target, form.smallest)
    blocks = _blocks(form, target)
    # One channel at a time, to save memory on large images.
    channels = (
        _channel_map(_block_means(x, blocks), _block_means(y, blocks), form)
        for x, y in zip(np.moveaxis(image, 2, 0), np.moveaxis(target, 2, 0))
    )
    return np.stack([*channels], axis=2)


def _channel_map(x: FloatArray, y: FloatArray, form: SsimForm) -> FloatArray:
    """(H', W') local similarity of one channel, (H, W) from 0 to 255."""
    import cv2

    borders = {"valid": cv2.BORDER_REFLECT, "reflect": cv2.BORDER_REFLECT_101, "zero": cv2.BORDER_CONSTANT}
    window, inset = form.weights, form.inset

    def blur(values: FloatArray) -> FloatArray:
        blurred = cv2.sepFilter2D(values, cv2.CV_64F, window, window, borderType=borders[form.border])
        height, width = values.shape
        return np.asarray(blurred[inset : height - inset, inset : width - inset], dtype=np.float64)

    # Only the sum of the two variances enters the formula, so four filters are enough instead of five.
    mean_x, mean_y = blur(x), blur(y)
    mean_product = mean_x * mean_y
    mean_squares = mean_x * mean_x + mean_y * mean_y
    covariance = form.covariance_scale * (blur(x * y) - mean_product)
    variances = form.covariance_scale * (blur(x * x + y * y) - mean_squares)
    numerator = (2.0 * mean_product + C1) * (2.0 * covariance + C2)
    return numerator / ((mean_squares + C1) * (variances + C2))


def _blocks(form: SsimForm, image: ByteArray) -> int:
    """Side of the blocks that are averaged before SSIM."""
    return max(1, round(min(image.shape[:2]) / 256)) if form.downsample else 1


def _block_means(array: ByteArray | Mask, side: int) -> FloatArray:
    """Means of an (H, W) array over whole blocks, float64; remaining rows and columns are dropped."""
    values = array.astype(np.float64)
    if side == 1:
        return values
    height, width = array.shape[0] // side, array.shape[1] // side
    values = values[: height * side, : width * side]
    return values.reshape(height, side, width, side, *array.shape[2:]).mean(axis=(1, 3))


ssim = Ssim()
"""The canonical form; scikit-image with ``gaussian_weights=True, sigma=1.5, use_sample_covariance=False``, torchmetrics
before 1.4.2, dm_pix, pytorch-msssim."""
ssim_zero_border = Ssim(SsimForm(border="zero"))
"""Training loss and ``metrics.py`` of 3D Gaussian splatting and its derivatives."""
ssim_reflected = Ssim(SsimForm(border="reflect"))
"""torchmetrics from 1.4.2."""
ssim_uniform = Ssim(SsimForm(window="uniform", sample_covariance=True))
"""scikit-image's default with ``channel_axis=2, data_range=255``."""
ssim_downsampled = Ssim(SsimForm(downsample=True))
"""piq's default."""
