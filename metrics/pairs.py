"""The checks that every image metric makes before it computes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..bench.contracts import ByteArray
from ..bench.errors import InputError

Mask = NDArray[np.bool_]


def check_pair(image: ByteArray, truth: ByteArray, smallest: int = 1) -> None:
    """Raise `InputError` unless both are (H, W, 3) 8-bit images of one size, H and W at least ``smallest``."""
    for key, array in (("image", image), ("truth", truth)):
        if not isinstance(array, np.ndarray) or array.dtype != np.uint8:
            found = str(getattr(array, "dtype", type(array).__name__))
            remedy = "Quantise renders with headbench.bench.io.frames.quantise."
            raise InputError("metric", key, "an array of 8-bit unsigned integers", found, remedy)
        if array.ndim != 3 or array.shape[2] != 3:
            raise InputError("metric", key, "shape (height, width, 3)", str(array.shape))
        if min(array.shape[:2]) < smallest:
            raise InputError(
                "metric", key, f"at least {smallest} pixels in height and width", str(array.shape)
            )
    if image.shape != truth.shape:
        raise InputError("metric", "image", f"the shape of the truth, {truth.shape}", str(image.shape))


def stack_masks(masks: Mapping[str, Mask], truth: ByteArray) -> ByteArray:
    """(R, H, W) 8-bit stack of the masks of regions, 1 inside.

    Raises `InputError` for one that is not boolean or not of the truth's size.
    """
    size = truth.shape[:2]
    for name, mask in masks.items():
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != size:
            found = f"{getattr(mask, 'dtype', type(mask).__name__)} {getattr(mask, 'shape', '')}"
            raise InputError("metric", f"mask of {name}", f"a boolean array of shape {size}", found)
    if not masks:
        return np.empty((0, *size), np.uint8)
    return np.stack([mask.view(np.uint8) for mask in masks.values()])
