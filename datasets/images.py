"""Reading and writing of images and masks, with a memory-bounded LRU cache of decoded ones.

The sRGB curve.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable, Iterable
from pathlib import Path

import cv2
import numpy as np

from ..bench.contracts import ByteArray, FloatArray
from ..bench.errors import InputError
from ..bench.io.files import write_bytes
from ..bench.io.images import encode_image, probe_image, read_pixels


def srgb_to_linear(values: FloatArray) -> FloatArray:
    """Decode sRGB in [0, 1] (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


_ROWS = 64


class ImageStore:
    """Reads images and masks, keeping at most ``limit_mb`` (10^6 bytes) of decoded pixels.

    Thread-safe; the lock is not held during decoding, so two threads that request an image at once may both decode it.
    Arrays are shared, hence read-only.
    """

    def __init__(self, limit_mb: float = 512.0):
        if limit_mb < 0:
            raise InputError("image store", "limit_mb", "a number from 0", f"{limit_mb}")
        self._limit = int(limit_mb * 1e6)
        self._held = 0
        self._arrays: OrderedDict[Hashable, ByteArray] = OrderedDict()
        self._lock = threading.Lock()

    def image(self, path: Path, background: Iterable[float]) -> ByteArray:
        """(H, W, 3) 8-bit RGB; straight alpha is composited on ``background`` (three numbers in [0, 1])."""
        return self._get(path, tuple(float(c) for c in background))

    def mask(self, path: Path) -> ByteArray:
        """(H, W) 8-bit coverage, see `read_mask`."""
        return self._get(path, None)

    def _get(self, path: Path, background: tuple[float, ...] | None) -> ByteArray:
        key = (path, background)
        array = self.find(key)
        if array is None:
            array = read_mask(path) if background is None else read_image(path, background)
            self.keep(key, array)
        return array

    def find(self, key: Hashable) -> ByteArray | None:
        """Cached array of a key, or None."""
        with self._lock:
            if key not in self._arrays:
                return None
            self._arrays.move_to_end(key)
            return self._arrays[key]

    def keep(self, key: Hashable, array: ByteArray) -> None:
        """Make an array read-only and cache it."""
        array.flags.writeable = False
        with self._lock:
            if key not in self._arrays and array.nbytes <= self._limit:
                self._arrays[key] = array
                self._held += array.nbytes
                while self._held > self._limit:
                    _, oldest = self._arrays.popitem(last=False)
                    self._held -= oldest.nbytes


def read_image(path: Path, background: Iterable[float]) -> ByteArray:
    """Decode a PNG or JPEG to (H, W, 3) RGB, straight alpha composited on ``background`` and rounded."""
    pixels = read_pixels(path)
    if pixels.ndim == 2:
        return cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB).astype(np.uint8, copy=False)
    if pixels.shape[2] == 3:
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
    ground = np.array([*background], dtype=np.float32) * 255
    result = np.empty((*pixels.shape[:2], 3), np.uint8)
    for start in range(
        0, len(pixels), _ROWS
    ):  # converting all rows to floating point at once would take ten times the memory
        rgba = cv2.cvtColor(pixels[start : start + _ROWS], cv2.COLOR_BGRA2RGBA)
        alpha = rgba[..., 3:].astype(np.float32) / 255
        blended = rgba[..., :3] * alpha + ground * (1 - alpha)
        result[start : start + _ROWS] = np.round(blended)
    return result


def read_mask(path: Path, size: tuple[int, int] | None = None, *, own: bool = False) -> ByteArray:
    """Decode a mask to (H, W) 8-bit coverage; ``own``: the alpha channel of the image that it belongs to.

    The coverage is the alpha channel if there is one, else the grey level, else the largest of the three channels.
    Entries of a colour table that are not all grey are labels: all except black are covered fully. An alpha channel
    that is opaque everywhere is ignored, since some editors always save one, unless it is the image's ``own``.
    ``size`` and errors are those of `read_pixels`.
    """
    pixels = read_pixels(path, size)
    if pixels.ndim == 2:
        return pixels
    blue, green, red, *alpha = (channel.astype(np.uint8, copy=False) for channel in cv2.split(pixels))
    grey = np.array_equal(blue, green) and np.array_equal(green, red)
    if alpha and (own or alpha[0].min() < 255):
        return alpha[0]
    if not grey and probe_image(path).table:
        return np.where((blue | green | red) > 0, 255, 0).astype(np.uint8)
    return np.maximum(np.maximum(blue, green), red)


def is_whole(path: Path, width: int, height: int) -> bool:
    """Whether a complete image of that size exists; a crash can leave a renamed file without content."""
    try:
        info = probe_image(path)
    except InputError:
        return False
    return (info.width, info.height) == (width, height)


def write_image(path: Path, image: ByteArray, *options: int) -> None:
    """Write (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA, 8-bit, atomically; ``options`` are OpenCV's. The suffix
    decides the format."""
    write_bytes(path, encode_image(image, path.suffix, options, place=path))
