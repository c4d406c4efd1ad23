"""Peak signal-to-noise ratio of one frame."""

from __future__ import annotations

import math

import numpy as np

from ..bench.contracts import ByteArray
from .pairs import check_pair

CAP = 100.0


def psnr(image: ByteArray, truth: ByteArray) -> float:
    """PSNR in dB over all pixels and channels of two (H, W, 3) 8-bit images, at most 100 dB.

    ``10 log10(255^2 / mse)``. The squared error is summed exactly, in integers. The cap keeps identical frames
    (a blank view, a closed shutter) from turning a mean over frames into infinity.
    """
    check_pair(image, truth)
    difference = image.astype(np.int32) - truth
    squared_error = int(np.sum(np.square(difference, out=difference), dtype=np.int64))
    if squared_error == 0:
        return CAP
    return min(CAP, 10.0 * math.log10(255.0**2 * image.size / squared_error))
