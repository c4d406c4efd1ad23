"""Pairs of 8-bit images: the checks that every image metric makes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..bench.contracts import ByteArray
from ..bench.errors import InputError, UnavailableError

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
