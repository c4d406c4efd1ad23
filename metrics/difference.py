"""L1 and L2 of one frame: the mean absolute and the mean squared error of images in [0, 1]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..bench.contracts import ByteArray
from ..bench.specs import MetricSpec
from .psnr import Mask, check_masks, check_pair


@dataclass(frozen=True)
class PixelError:
    """Mean over pixels and channels of the absolute difference, to a power, of images in [0, 1]."""

    power: int

    def __call__(self, image: ByteArray, target: ByteArray) -> float:
        """Mean over all pixels of two (H, W, 3) 8-bit images."""
        return self.in_regions(image, target, {"": np.ones(target.shape[:2], np.bool_)})[""]

    def in_regions(self, image: ByteArray, target: ByteArray, masks: Mapping[str, Mask]) -> dict[str, float]:
        """Mean over the pixels of each (H, W) boolean mask; regions without pixels are left out."""
        check_pair(image, target)
        check_masks(masks, target)
        # Sums of integers below 2^53 are exact in float64.
        errors = (np.abs(image.astype(np.float64) - target) ** self.power).sum(axis=2)
        scale = 3 * 255.0**self.power
        return {name: float(errors[mask].mean()) / scale for name, mask in masks.items() if mask.any()}


l1 = PixelError(1)
l2 = PixelError(2)


def _spec(name: str, label: str, digits: int, summary: str) -> MetricSpec:
    return MetricSpec(
        name=name,
        label=label,
        unit="",
        higher_is_better=False,
        digits=digits,
        implementation=f"headbench.metrics.difference:{name}",
        summary=f"{summary} of images in [0, 1], over the frame or a region of it.",
        kind="regional",
    )


L1 = _spec("l1", "L1", 4, "Mean absolute error")
L2 = _spec("l2", "L2", 5, "Mean squared error")
