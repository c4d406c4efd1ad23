"""Pairs of 8-bit images: the checks that every image metric makes, and sums by the compiled kernel.

The kernel computes in float64 and runs on one thread without Python's lock, so that a pool of threads over frames uses the
whole machine. Its variants for different instruction sets give the same bits, as does numpy where it is missing.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..bench.contracts import ByteArray, IntArray
from ..bench.errors import InputError, UnavailableError
from ..bench.native.loader import Kernel

Mask = NDArray[np.bool_]
KERNEL = Kernel(
    "headbench.metrics._structural", "The kernel of the image metrics", "numpy does meanwhile, more slowly"
)


def check_pair(image: ByteArray, target: ByteArray, smallest: int = 1) -> None:
    """Raise `InputError` unless both are (H, W, 3) 8-bit images of one size.

    Raises `UnavailableError` where H or W is below ``smallest``: the metric has no value for such images, which is
    shown in its place.
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


def stack_masks(masks: Mapping[str, Mask], target: ByteArray) -> ByteArray:
    """(R, H, W) 8-bit stack of the masks of regions, 1 inside.

    Raises `InputError` for one that is not boolean or not of the ground truth's size.
    """
    size = target.shape[:2]
    for name, mask in masks.items():
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != size:
            found = f"{getattr(mask, 'dtype', type(mask).__name__)} {getattr(mask, 'shape', '')}"
            raise InputError("metric", f"mask of {name}", f"a boolean array of shape {size}", found)
    if not masks:
        return np.empty((0, *size), np.uint8)
    return np.stack([mask.view(np.uint8) for mask in masks.values()])


def squared_errors(image: ByteArray, target: ByteArray, masks: ByteArray) -> IntArray:
    """(1 + R, 3) int64 sums of the squared differences by channel: of the image, then inside each mask. Exact.

    Parameters
    ----------
    image, target : (H, W, 3) 8-bit.
    masks : (R, H, W) 8-bit, not 0 inside.
    """
    module = KERNEL.load_or_warn()
    if module is None:
        return squared_errors_numpy(image, target, masks)
    arrays = (np.ascontiguousarray(array) for array in (image, target, masks))
    sums = module.squared_error(*arrays, KERNEL.instruction_sets[0])
    return np.array(sums, dtype=np.int64).reshape(-1, 3)


def squared_errors_numpy(image: ByteArray, target: ByteArray, masks: ByteArray) -> IntArray:
    """The definition of `squared_errors`."""
    square = (image.astype(np.int64) - target) ** 2
    return np.stack([square.sum(axis=(0, 1)), *(square[mask != 0].sum(axis=0) for mask in masks)])
