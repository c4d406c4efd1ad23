"""Flicker: temporal change of the image that differs from that of the ground truth."""

from __future__ import annotations

import math

import numpy as np

from ..bench.contracts import ByteArray
from ..bench.specs import MetricSpec
from .psnr import check_pair

FLICKER = MetricSpec(
    name="flicker",
    label="Flicker",
    unit="levels",
    higher_is_better=False,
    digits=3,
    implementation="headbench.metrics.flicker:flicker",
    summary="Change between neighbouring frames that the ground truth does not have, root mean square, 8-bit levels.",
    kind="temporal",
)


def flicker(image: ByteArray, target: ByteArray, other_image: ByteArray, other_target: ByteArray) -> float:
    """Root mean square, in 8-bit levels, of ``(image - other_image) - (target - other_target)``.

    ``other`` is a neighbour in time from the same camera; the order of the two does not matter. Errors that
    both frames share (a wrong colour, a blur that moves along) cancel; others do not. 0 for a render that
    changes as the ground truth does. All are (H, W, 3) 8-bit images of one size.
    """
    check_pair(image, target)
    check_pair(other_image, other_target)
    check_pair(image, other_image)
    change = np.subtract(image, other_image, dtype=np.int32)
    change -= target
    change += other_target
    return math.sqrt(np.square(change).sum(dtype=np.int64) / change.size)
