"""Convert a raw frame to the image of a capture: smaller, colour-calibrated, on white if there is a mask.

Two forms of colour calibration exist. Version 1 is an affine map on the stored values, ``SER.npy``. Version 2 is a
polynomial on linear values, ``color_calibration.json``. Images are 8-bit sRGB before and after. VHAP's reader
computes the version 2 correction and then returns the uncorrected image, so exports made with it carry raw colours.

Formats read:

- NeRSemble's colour calibration, version 1 and 2. Written by the authors of tobias-kirschstein/nersemble-data@14e967e3,
  whose `src/nersemble_data/util/color_correction.py` it follows. Not checked on a file of the program.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, reduce
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...bench.contracts import ByteArray, FloatArray
from ...bench.errors import InputError
from ...bench.io.arrays import check_numbers, read_npy
from ...bench.io.images import read_bgr
from ..images import srgb_to_linear

Correction = Callable[[ByteArray], ByteArray]
"""From (H, W, 3) 8-bit RGB to the same."""

_LARGEST = 1e6  # of a coefficient; genuine ones are below 100
_CHANNELS = "rgb"
_PAIRS, _SQUARES, _CUBES = ("rg", "rb", "gb"), ("rr", "gg", "bb"), ("rrr", "ggg", "bbb")
_CYCLE, _COUNTERCYCLE = ("rrg", "ggb", "bbr"), ("rrb", "ggr", "bbg")
_QUARTIC_MIXED = ("rrgb", "rggb", "rgbb")
_SECOND = (*_PAIRS, *_SQUARES, "rgb")
_THIRD = (*_SECOND, *_CYCLE, *_COUNTERCYCLE, *_CUBES)
_FOURTH = (
    *("rrrg", "rrrb", "gggr", "gggb", "bbbr", "bbbg"),
    *_QUARTIC_MIXED,
    *("rrgg", "rrbb", "ggbb"),
    *("rrrr", "gggg", "bbbb"),
)
_BEYOND_LINEAR: dict[int, tuple[str, ...]] = {
    3: (),
    4: ("",),
    5: ("rgb", ""),
    7: (*_PAIRS, ""),
    8: (*_PAIRS, "rgb", ""),
    10: (*_PAIRS, *_SQUARES, ""),
    11: (*_SECOND, ""),
    14: (*_SECOND, *_CUBES, ""),
    16: (*_SECOND, *_CYCLE, *_CUBES),
    17: (*_SECOND, *_CYCLE, *_CUBES, ""),
    19: _THIRD,
    20: (*_THIRD, ""),
    22: (*_THIRD, *_QUARTIC_MIXED),
    35: (*_THIRD, *_FOURTH, ""),
}

POLYNOMIALS = {count: (*_CHANNELS, *beyond) for count, beyond in _BEYOND_LINEAR.items()}
"""Terms by their count, each a product of channels ("rrg" is R R G, "" the constant 1): the augmented
matrices of Cheung, Westland, Connah, Ripamonti (2004), in colour-science's order."""


def linear_to_srgb(values: FloatArray) -> FloatArray:
    """Encode linear values to sRGB, clipped to [0, 1]; float32, (H, W, C)."""
    clipped = np.clip(values, 0, 1).astype(np.float32)
    curved = 1.055 * cv2.pow(clipped, 1 / 2.4).reshape(clipped.shape) - 0.055
    return np.where(clipped <= 0.0031308, 12.92 * clipped, curved)


_LINEAR = srgb_to_linear(np.arange(256) / 255).astype(np.float32)
_LINEAR.flags.writeable = False

_STEPS = 2**16 - 1
"""Steps of linear values in `_ENCODED`. A level spans at least 20 steps, so results are within 0.53 levels of the
exact ones instead of 0.5."""

_ENCODED = (
    np.rint(255 * linear_to_srgb((np.arange(_STEPS + 1) / _STEPS).reshape(1, -1, 1))).astype(np.uint8).ravel()
)
_ENCODED.flags.writeable = False


@dataclass(frozen=True, eq=False)
class AffineCorrection:
    """Version 1: ``out = rgb @ matrix[:, :3] + matrix[:, 3]`` on stored values in [0, 1], clipped. ``rgb`` is a row on
    the left, so the linear part is the transpose of the usual form."""

    matrix: FloatArray  # (3, 4)

    def __call__(self, image: ByteArray) -> ByteArray:
        if self.is_identity:
            return image
        usual = np.hstack([self.matrix[:, :3].T, 255 * self.matrix[:, 3:]])
        return _to_bytes(cv2.transform(image.astype(np.float32), usual))

    @property
    def is_identity(self) -> bool:
        """Whether images come back as they are."""
        return np.array_equal(self.matrix, np.eye(3, 4))


@dataclass(frozen=True, eq=False)
class PolynomialCorrection:
    """Version 2: decode sRGB, ``matrix @ terms``, encode sRGB, clip; terms as in `POLYNOMIALS`."""

    matrix: FloatArray  # (3, N)

    def __call__(self, image: ByteArray) -> ByteArray:
        if self.is_identity:
            return image
        linear = _LINEAR[image]
        height, width, _ = image.shape
        terms = self._expand(linear).reshape(-1, height * width)
        planes = self.matrix.astype(np.float32) @ terms
        steps = np.clip(planes * _STEPS + 0.5, 0, _STEPS).astype(np.uint16)
        return cv2.merge([*_ENCODED[steps].reshape(3, height, width)]).astype(np.uint8, copy=False)

    @property
    def is_identity(self) -> bool:
        """Whether images come back as they are."""
        return np.array_equal(self.matrix, np.eye(*self.matrix.shape))

    @cached_property
    def _terms(self) -> tuple[str, ...]:
        return POLYNOMIALS[self.matrix.shape[1]]

    def _expand(self, linear: FloatArray) -> FloatArray:
        """(N, H, W) terms of an (H, W, 3) image."""
        planes = dict(zip(_CHANNELS, np.moveaxis(linear, 2, 0)))
        terms = np.empty((len(self._terms), *linear.shape[:2]), dtype=np.float32)
        for target, term in zip(terms, self._terms):
            target[...] = reduce(np.multiply, (planes[c] for c in term), np.float32(1))
        return terms


def _to_bytes(levels: NDArray[Any]) -> ByteArray:
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def affine_correction(path: Path) -> AffineCorrection:
    """Read version 1, ``SER.npy``."""
    matrix = read_npy(path)
    if matrix.dtype.kind not in "fiu" or matrix.shape not in ((3, 4), (4, 4)):
        found = f"{matrix.dtype} {matrix.shape}"
        raise InputError(path, "", "an affine matrix of numbers, (4, 4) or (3, 4)", found)
    check_numbers(path, "", matrix, _LARGEST)
    return AffineCorrection(matrix[:3].astype(np.float64))


def polynomial_correction(path: Path, serial: str, value: Any) -> PolynomialCorrection:
    """Check one entry of version 2's JSON: a 3 x N matrix with N out of `POLYNOMIALS`."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.ndim != 2 or matrix.shape[0] != 3 or matrix.shape[1] not in POLYNOMIALS:
        counts = ", ".join(map(str, POLYNOMIALS))
        found = f"shape {matrix.shape}" if matrix.size else repr(value)[:60]
        raise InputError(path, serial, f"a 3 x N matrix of numbers, N out of {counts}", found)
    check_numbers(path, serial, matrix, _LARGEST)
    return PolynomialCorrection(matrix)


def prepare_pixels(
    bgr: ByteArray,
    mask: ByteArray | None,
    size: tuple[int, int],
    correct: Correction | None = None,
    still: ByteArray | None = None,
) -> tuple[ByteArray, ByteArray | None]:
    """Shrink a frame by averaging areas, correct its colours, put it on white.

    With a mask a, only the contribution of the foreground is averaged and corrected. With the still B of the empty
    set, it is I - (1 - a) B, within [0, a], which removes the background from soft edges. Without it, it is a I, as in
    VHAP, and edges keep a fraction a (1 - a) of the background. Colours are corrected at the small size, as VHAP does.

    ``bgr``: (H, W, 3) in OpenCV's channel order. ``mask``: (H, W) foreground coverage; with None the image keeps its
    background. ``size``: (width, height) of the result, at most the frame's. ``still``: (H, W, 3) image of the empty set
    from the same camera, in OpenCV's channel order.

    Returns
    -------
    tuple[ByteArray, ByteArray | None]
        (h, w, 3) RGB and the (h, w) mask, or None without a mask.
    """
    if mask is None:
        rgb = cv2.cvtColor(_shrink(bgr, size), cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        return (correct(rgb) if correct else rgb), None
    weighted = cv2.cvtColor(_shrink(_foreground_share(bgr, mask, still), size), cv2.COLOR_BGR2RGB)
    mask = _shrink(mask, size)
    coverage = cv2.merge([mask] * 3)
    if correct:
        straight = cv2.divide(weighted, coverage, scale=255).astype(np.uint8, copy=False)
        weighted = cv2.multiply(correct(straight), coverage, scale=1 / 255)
    white_share = cv2.bitwise_not(coverage)
    return cv2.add(weighted, white_share).astype(np.uint8, copy=False), mask


def _foreground_share(bgr: ByteArray, mask: ByteArray, still: ByteArray | None) -> ByteArray:
    coverage = cv2.merge([mask] * 3)
    if still is None:
        return cv2.multiply(bgr, coverage, scale=1 / 255).astype(np.uint8, copy=False)
    behind = cv2.multiply(still, cv2.bitwise_not(coverage), scale=1 / 255)
    return cv2.min(cv2.subtract(bgr, behind), coverage).astype(np.uint8, copy=False)


def read_still(path: Path, size: tuple[int, int]) -> ByteArray:
    """Still of the empty set as OpenCV decodes it, resized to the frames' (width, height)."""
    still = read_bgr(path)
    return cv2.resize(still, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def _shrink(image: ByteArray, size: tuple[int, int]) -> ByteArray:
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
