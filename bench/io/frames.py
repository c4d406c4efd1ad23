"""Rendered colour to stored 8-bit frames, and back. Lossless PNG, never JPEG or video."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ..contracts import ByteArray, FloatArray
from ..errors import InputError
from .files import write_bytes
from .images import read_pixels


def quantise(rgb: FloatArray) -> ByteArray:
    """Round colours in [0, 1] to 8 bits, to the nearest level; what lies outside is clamped.

    Truncating (``rgb * 255`` cast to an integer) would darken by half a level on average. Raises `InputError`
    for a non-finite colour, since any level chosen for it would hide a fault of the renderer, and for an
    array that is not floating point.
    """
    if not np.issubdtype(rgb.dtype, np.floating):
        raise InputError("render", "rgb", "a floating-point array in [0, 1]", str(rgb.dtype))
    finite = np.isfinite(rgb)
    if not finite.all():
        found = f"{rgb.size - int(finite.sum())} of {rgb.size} values infinite or not a number"
        raise InputError("render", "rgb", "finite colours", found)
    return np.rint(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8)


def write_png(path: Path, image: ByteArray) -> bytes:
    """Write an (H, W, 3) 8-bit sRGB image, atomically; return what was written."""
    ok, encoded = cv2.imencode(
        ".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 3]
    )
    if not ok:
        raise InputError(path, "", "an image that PNG can hold", f"shape {image.shape}, {image.dtype}")
    content = encoded.tobytes()
    write_bytes(path, content)
    return content


def read_png(path: Path) -> ByteArray:
    """Read an (H, W, 3) 8-bit sRGB image. Raises `InputError` for a missing or damaged file."""
    image = read_pixels(path, cv2.IMREAD_COLOR)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
