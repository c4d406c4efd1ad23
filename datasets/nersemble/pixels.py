"""From a raw frame to the image of a capture: smaller, corrected, on white where there is a matte."""

from __future__ import annotations

import cv2
import numpy as np

from ...bench.contracts import ByteArray, FloatArray
from .colour import Correction

WHITE = 255


def prepare_pixels(
    bgr: ByteArray, matte: ByteArray | None, size: tuple[int, int], correct: Correction | None
) -> tuple[ByteArray, ByteArray | None]:
    """Shrink a frame by averaging areas, correct its colours, put it on white.

    With a matte, the foreground alone is averaged (colours weighted by coverage), so that no background leaks
    into the edge, before or after the correction. Colours are corrected at the small size, as VHAP does.

    Parameters
    ----------
    bgr : (H, W, 3) as OpenCV decodes.
    matte : (H, W) foreground coverage, or None: the image then keeps its background.
    size : (width, height) of the result, at most the frame's.

    Returns
    -------
    (h, w, 3) RGB and the (h, w) mask, or None without a matte.
    """
    if matte is None:
        rgb = cv2.cvtColor(_shrink(bgr, size), cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        return (correct(rgb) if correct else rgb), None
    covered = cv2.multiply(bgr, cv2.merge([matte] * 3), scale=1 / 255)
    weighted = cv2.cvtColor(_shrink(covered.astype(np.uint8, copy=False), size), cv2.COLOR_BGR2RGB)
    mask = _shrink(matte, size)
    coverage = mask[..., None].astype(np.float32) / 255
    foreground: FloatArray = weighted.astype(np.float32)
    if correct:
        straight = np.minimum(np.rint(foreground / np.maximum(coverage, 1 / 255)), 255).astype(np.uint8)
        foreground = correct(straight) * coverage
    on_white = np.rint(foreground + WHITE * (1 - coverage))
    return np.minimum(on_white, 255).astype(np.uint8), mask


def _shrink(image: ByteArray, size: tuple[int, int]) -> ByteArray:
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
