"""Peak signal-to-noise ratio of one frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..bench.contracts import ByteArray, FloatArray, IntArray
from ..bench.specs import MetricSpec
from .pairs import Mask, check_masks, check_pair

PSNR = MetricSpec(
    name="psnr",
    label="PSNR",
    unit="dB",
    higher_is_better=True,
    digits=2,
    implementation="headbench.metrics.psnr:psnr",
    summary="Peak signal-to-noise ratio over the 8-bit frame, or over a region of it, capped at 100 dB.",
    kind="regional",
    default=True,
    # The best of the suite's 60,480 whole frames, over all native methods and baselines, has 45.5 dB. 8-bit rounding
    # limits a perfect render to 58.9 dB, unless it is the test image itself.
    suspect_above=50.0,
)

CAP = 100.0


@dataclass(frozen=True)
class Psnr:
    """PSNR in dB of 8-bit images, ``10 log10(255^2 / mse)``, at most 100 dB.

    The squared error is summed exactly, in integers. The cap keeps means over frames finite if some frames are
    identical, such as blank ones.
    """

    per_channel: bool = False
    """Mean of the PSNRs of red, green and blue, as the training code of GaussianAvatars prints; never below that of all samples
    together (Jensen)."""
    floor: float = 0.0
    """Added to the mean squared error of images in [0, 1], as in piq."""

    def __call__(self, image: ByteArray, target: ByteArray) -> float:
        """PSNR over all pixels of two (H, W, 3) images."""
        check_pair(image, target)
        errors = squared_errors(image, target).sum(axis=(0, 1)).astype(np.int64)
        return self._decibels(errors, image.shape[0] * image.shape[1])

    def in_regions(self, image: ByteArray, target: ByteArray, masks: Mapping[str, Mask]) -> dict[str, float]:
        """PSNR over the pixels of each (H, W) boolean mask; the mean squared error is over the region alone.

        Regions without pixels are left out.
        """
        check_pair(image, target)
        check_masks(masks, target)
        pixels = squared_errors(image, target).reshape(-1, 3)
        counts = {name: int(mask.sum()) for name, mask in masks.items()}
        # Integer sums below 2^53 are exact in float64, and a float64 matrix product is the fastest way to sum.
        sums = {
            name: masks[name].ravel().astype(np.float64) @ pixels for name, count in counts.items() if count
        }
        return {name: self._decibels(errors.astype(np.int64), counts[name]) for name, errors in sums.items()}

    def _decibels(self, errors: IntArray, pixels: int) -> float:
        """PSNR from the (3,) summed squared error of each channel."""
        groups = errors if self.per_channel else errors.sum(keepdims=True)
        samples = 3 * pixels // len(groups)
        return float(np.mean([self._of_mean(int(error) / (255.0**2 * samples)) for error in groups]))

    def _of_mean(self, error: float) -> float:
        error += self.floor
        return CAP if error == 0 else min(CAP, -10.0 * math.log10(error))


def squared_errors(image: ByteArray, target: ByteArray) -> FloatArray:
    """(H, W, 3) squared differences of two 8-bit images, integers in float64."""
    return (image.astype(np.float64) - target) ** 2


psnr = Psnr()
psnr_by_channel = Psnr(per_channel=True)
psnr_floored = Psnr(floor=1e-8)
