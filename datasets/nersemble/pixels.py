"""From a raw frame to the image of a capture: smaller, corrected, on white where there is a matte."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ...bench.contracts import ByteArray
from ...bench.io.images import read_pixels
from .colour import Correction


def prepare_pixels(
    bgr: ByteArray,
    matte: ByteArray | None,
    size: tuple[int, int],
    correct: Correction | None = None,
    still: ByteArray | None = None,
) -> tuple[ByteArray, ByteArray | None]:
    """Shrink a frame by averaging areas, correct its colours, put it on white.

    With a matte a, what the foreground adds to the frame is averaged, so that nothing but foreground takes part
    in the correction. Given the still B of the empty set, that is I - (1 - a) B, within [0, a]: the background
    that shines through soft edges is taken away. Without, it is a I, as VHAP has it, and edges keep a share
    a (1 - a) of the background. Colours are corrected at the small size, as VHAP does.

    Parameters
    ----------
    bgr : (H, W, 3) as OpenCV decodes.
    matte : (H, W) foreground coverage, or None: the image then keeps its background.
    size : (width, height) of the result, at most the frame's.
    still : (H, W, 3) as OpenCV decodes, the empty set from the same camera.

    Returns
    -------
    (h, w, 3) RGB and the (h, w) mask, or None without a matte.
    """
    if matte is None:
        rgb = cv2.cvtColor(_shrink(bgr, size), cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        return (correct(rgb) if correct else rgb), None
    weighted = cv2.cvtColor(_shrink(_foreground_share(bgr, matte, still), size), cv2.COLOR_BGR2RGB)
    mask = _shrink(matte, size)
    coverage = cv2.merge([mask] * 3)
    if correct:
        straight = cv2.divide(weighted, coverage, scale=255).astype(np.uint8, copy=False)
        weighted = cv2.multiply(correct(straight), coverage, scale=1 / 255)
    white_share = cv2.bitwise_not(coverage)
    return cv2.add(weighted, white_share).astype(np.uint8, copy=False), mask


def _foreground_share(bgr: ByteArray, matte: ByteArray, still: ByteArray | None) -> ByteArray:
    coverage = cv2.merge([matte] * 3)
    if still is None:
        return cv2.multiply(bgr, coverage, scale=1 / 255).astype(np.uint8, copy=False)
    behind = cv2.multiply(still, cv2.bitwise_not(coverage), scale=1 / 255)
    return cv2.min(cv2.subtract(bgr, behind), coverage).astype(np.uint8, copy=False)


def read_still(path: Path, size: tuple[int, int]) -> ByteArray:
    """Still of the empty set as OpenCV decodes it, brought to the frames' (width, height).

    Raises `InputError` where it does not decode.
    """
    still = read_pixels(path, cv2.IMREAD_COLOR)
    return cv2.resize(still, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def _shrink(image: ByteArray, size: tuple[int, int]) -> ByteArray:
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
