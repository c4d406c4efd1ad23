"""Resizing of images: antialiased, exact about where pixel centres are.

Image coordinates count from the top left corner of the top left pixel, so that an image of another size covers the
same extent and coordinates scale without an offset: x' = x * width' / width. Colours are resampled as they are
stored (display-referred), which is what the field's tools do.
"""

from __future__ import annotations

import cv2
import numpy as np
from PIL import Image

from ..bench.contracts import FloatArray
from ..bench.errors import InputError

MAX_SIDE = 32767
"""Longest side of an image here; OpenCV's own resizing goes no further."""


def resize_image(image: FloatArray, width: int, height: int) -> FloatArray:
    """Resize a float32 image (H, W) or (H, W, C).

    Where both sides shrink by whole factors every pixel is the mean of the block it covers. Otherwise the kernel is
    Keys' cubic (a = -1/2, "Cubic convolution interpolation for digital image processing", 1981), widened by the
    factor where a side shrinks, so that nothing aliases; it reproduces linear ramps and overshoots at edges by up to
    some per cent: clamp where that matters. Weights that would fall outside the image are left out and the rest
    renormalised.

    Raises
    ------
    InputError
        For a size without pixels or beyond `MAX_SIDE`, and for images that are not float32.
    """
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise InputError("resize", "size", f"sides of 1 to {MAX_SIDE} pixels", f"{width}x{height}")
    if image.dtype != np.float32 or image.ndim not in (2, 3) or 0 in image.shape:
        found = f"{image.dtype} of shape {image.shape}"
        raise InputError("resize", "image", "float32 of shape (H, W) or (H, W, C)", found)
    rows, columns = image.shape[:2]
    if (rows, columns) == (height, width):
        return image
    if rows % height == 0 and columns % width == 0:
        return block_means(image, columns // width, rows // height)
    planes = image[..., None] if image.ndim == 2 else image
    resized = [_cubic(planes[..., channel], width, height) for channel in range(planes.shape[2])]
    return resized[0] if image.ndim == 2 else np.stack(resized, axis=-1)


def block_means(image: FloatArray, across: int, down: int) -> FloatArray:
    """Means over blocks of ``across`` by ``down`` pixels, which have to tile the image."""
    size = (image.shape[1] // across, image.shape[0] // down)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32).reshape(
        size[1], size[0], *image.shape[2:]
    )


def _cubic(plane: FloatArray, width: int, height: int) -> FloatArray:
    # Pillow's bicubic is Keys' with a = -1/2 and widens when shrinking; OpenCV's (a = -3/4) bends ramps and aliases.
    source = Image.fromarray(np.ascontiguousarray(plane))
    return np.asarray(source.resize((width, height), Image.Resampling.BICUBIC), dtype=np.float32)
