"""Sums over 8-bit images by the compiled kernel, or by numpy where it is missing: the same values.

The kernel computes in float64 and runs on one thread without Python's lock, so that a pool of threads over frames
uses the whole machine. Its variants for different instruction sets give the same bits.
"""

from __future__ import annotations

import numpy as np

from ..bench.contracts import ByteArray, IntArray
from ..bench.native.loader import Kernel

KERNEL = Kernel(
    "headbench.metrics._structural", "The kernel of the image metrics", "numpy does meanwhile, more slowly"
)


def squared_errors(image: ByteArray, truth: ByteArray, masks: ByteArray) -> IntArray:
    """(1 + R, 3) int64 sums of the squared differences by channel: of the image, then inside each mask. Exact.

    Parameters
    ----------
    image, truth : (H, W, 3) 8-bit.
    masks : (R, H, W) 8-bit, not 0 inside.
    """
    module = KERNEL.load_or_warn()
    if module is None:
        return squared_errors_numpy(image, truth, masks)
    arrays = (np.ascontiguousarray(array) for array in (image, truth, masks))
    sums = module.squared_error(*arrays, KERNEL.instruction_sets[0])
    return np.array(sums, dtype=np.int64).reshape(-1, 3)


def squared_errors_numpy(image: ByteArray, truth: ByteArray, masks: ByteArray) -> IntArray:
    """The definition of `squared_errors`."""
    square = (image.astype(np.int64) - truth) ** 2
    return np.stack([square.sum(axis=(0, 1)), *(square[mask != 0].sum(axis=0) for mask in masks)])
