"""Blurred images of all frames, sampled with their gradients."""

from __future__ import annotations

import numpy as np

from ...bench.contracts import ByteArray, FloatArray, IntArray


class FrameStack:
    """Images of N frames as one row of pixels.

    Parameters
    ----------
    images : list[ByteArray]
        (H, W, 3) 8-bit images; sizes may differ.
    """

    def __init__(self, images: list[ByteArray]):
        self._images = images
        self.sizes = np.array([[image.shape[1], image.shape[0]] for image in images])
        counts = self.sizes.prod(axis=1)
        self._starts = np.concatenate([[0], np.cumsum(counts)])
        self._pixels = np.zeros((int(self._starts[-1]), 3), np.int16)

    def filter(self, sigma: float, wide: float = 0.0) -> None:
        """Blur the sampled images by ``sigma`` pixels, and subtract their blur by ``wide``; 0 for none.

        The difference contains less of slow changes such as shading, which turns with the head.
        """
        for start, image in zip(self._starts, self._images):
            levels: FloatArray = np.asarray(image * np.float32(_LEVELS / 255), np.float32)
            if sigma > 0:
                levels = _blurred(levels, sigma)
            if wide > 0:
                levels = levels - _blurred(levels, wide)
            flat = levels.reshape(-1, 3)
            self._pixels[start : start + len(flat)] = np.round(flat)

    def sample(self, frames: IntArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values (n, 3), 1 being white, and gradients (n, 3, 2) per pixel at places (n, 2) of frames (n,), bilinear.

        Places outside an image take its border.
        """
        sizes = self.sizes[frames]
        place = np.clip(pixels - 0.5, 0, sizes - 1.001)
        corner = place.astype(np.int64)
        x, y = (place - corner).astype(np.float32).T[..., None]
        width = sizes[:, 0]
        index = self._starts[frames] + corner[:, 1] * width + corner[:, 0]
        a, b, c, d = (
            self._pixels[at].astype(np.float32) for at in (index, index + 1, index + width, index + width + 1)
        )
        upper, lower = a + x * (b - a), c + x * (d - c)
        value = upper + y * (lower - upper)
        along = (b - a) + y * ((d - c) - (b - a))
        scale = np.float32(1 / _LEVELS)
        return value * scale, np.stack([along, lower - upper], axis=2) * scale


_LEVELS = 16384.0  # of stored values, so that blurred images are not rounded to 8 bits


def _blurred(levels: FloatArray, sigma: float) -> FloatArray:
    import cv2  # not everywhere where methods are trained

    return np.asarray(cv2.GaussianBlur(levels, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))
