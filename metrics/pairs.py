"""The one check that every image metric makes before it computes."""

from __future__ import annotations

import numpy as np

from ..bench.contracts import ByteArray
from ..bench.errors import InputError


def check_pair(image: ByteArray, truth: ByteArray, smallest: int = 1) -> None:
    """Raise `InputError` unless both are (H, W, 3) 8-bit images of one size, H and W at least ``smallest``."""
    for key, array in (("image", image), ("truth", truth)):
        if not isinstance(array, np.ndarray) or array.dtype != np.uint8:
            found = str(getattr(array, "dtype", type(array).__name__))
            remedy = "Quantise renders with headbench.bench.frames.quantise."
            raise InputError("metric", key, "an array of 8-bit unsigned integers", found, remedy)
        if array.ndim != 3 or array.shape[2] != 3:
            raise InputError("metric", key, "shape (height, width, 3)", str(array.shape))
        if min(array.shape[:2]) < smallest:
            raise InputError(
                "metric", key, f"at least {smallest} pixels in height and width", str(array.shape)
            )
    if image.shape != truth.shape:
        raise InputError("metric", "image", f"the shape of the truth, {truth.shape}", str(image.shape))
