"""Peak signal-to-noise ratio of one frame, and checks of the images that all metrics compare."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..bench.contracts import ByteArray, FloatArray, IntArray
from ..bench.errors import InputError, UnavailableError
from ..bench.specs import MetricSpec

Mask = NDArray[np.bool_]


def check_pair(image: ByteArray, target: ByteArray, smallest: int = 1) -> None:
    """Raise `InputError` unless both are (H, W, 3) 8-bit images of one size.

    Raises `UnavailableError` if H or W is below ``smallest``: the metric is undefined for such images, and
    tables show that reason.
    """
    for key, array in (("image", image), ("target", target)):
        if not isinstance(array, np.ndarray) or array.dtype != np.uint8:
            found = str(getattr(array, "dtype", type(array).__name__))
            remedy = "Quantise renders with headbench.bench.io.images.quantise."
            raise InputError("metric", key, "an array of 8-bit unsigned integers", found, remedy)
        if array.ndim != 3 or array.shape[2] != 3 or not array.size:
            raise InputError("metric", key, "shape (height, width, 3)", str(array.shape))
    if image.shape != target.shape:
        raise InputError(
            "metric", "image", f"the shape of the ground truth, {target.shape}", str(image.shape)
        )
    height, width = image.shape[:2]
    if min(height, width) < smallest:
        note = f"The metric needs images of at least {smallest} x {smallest} pixels; these have {width} x {height}."
        raise UnavailableError(note, "Take larger images or leave out the metric.", note)


def check_masks(masks: Mapping[str, Mask], target: ByteArray) -> None:
    """Raise `InputError` for a mask of a region that is not boolean or not (H, W), the ground truth's size."""
    size = target.shape[:2]
    for name, mask in masks.items():
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != size:
            found = f"{getattr(mask, 'dtype', type(mask).__name__)} {getattr(mask, 'shape', '')}"
            raise InputError("metric", f"mask of {name}", f"a boolean array of shape {size}", found)


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
