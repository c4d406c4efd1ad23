"""FLIP: perceived per-pixel difference of two images that are shown alternately.

Andersson, Nilsson, Akenine-Moeller, Oskarsson, Astrom, Fairchild, "FLIP: a difference evaluator for
alternating images", Proc. ACM Comput. Graph. Interact. Tech. 3(2), 2020; numbers of sections and equations
are theirs. For images of low dynamic range, implemented from the formulas.

A pixel's error is in [0, 1]. It depends on the viewing size in pixels per degree of visual angle; the default
is the paper's viewer, 0.7 m before a monitor that is 0.7 m and 3840 pixels wide. The score is the mean of the
map.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..bench.contracts import ByteArray, FloatArray
from ..bench.specs import MetricSpec
from .psnr import Mask, check_masks, check_pair

FLIP = MetricSpec(
    name="flip",
    label="FLIP",
    unit="",
    higher_is_better=False,
    digits=4,
    implementation="headbench.metrics.flip:flip",
    summary="Difference seen when flipping between the images, LDR, 67.02 pixels per degree, mean of the map.",
    kind="regional",
)

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180

# Section 4.1, table 1: Gaussians of the contrast sensitivity of each opponent channel, (a1, b1, a2, b2).
_SENSITIVITY = ((1.0, 0.0047, 0.0, 1e-5), (1.0, 0.0053, 0.0, 1e-5), (34.1, 0.04, 13.5, 0.025))
_QC, _PC, _PT = 0.7, 0.4, 0.95  # section 4.1: exponent, and the knee of the redistribution
_FEATURE_WIDTH = 0.082  # section 4.2: width of an edge detector, degrees
_QF = 0.5  # section 4.2
# sRGB (D65) to XYZ, IEC 61966-2-1 with the primaries' chromaticities taken exactly.
_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
_WHITE = _TO_XYZ.sum(axis=1)


class _Filter(NamedTuple):
    """A sum of separable filters, each (vertical, horizontal) weights of odd length."""

    terms: tuple[tuple[FloatArray, FloatArray], ...]

    def __call__(self, channel: FloatArray) -> FloatArray:
        """Apply to an (H, W) channel; border pixels are replicated."""
        import cv2

        parts = [
            cv2.sepFilter2D(channel, cv2.CV_64F, across, down, borderType=cv2.BORDER_REPLICATE)
            for down, across in self.terms
        ]
        return np.sum(parts, axis=0, dtype=np.float64)


@dataclass(frozen=True)
class Flip:
    """FLIP of 8-bit images at a given viewing size."""

    pixels_per_degree: float = PIXELS_PER_DEGREE
    """Pixels per degree of visual angle."""

    def __call__(self, image: ByteArray, target: ByteArray) -> float:
        """Mean of `map` over all pixels, 0 for identical images."""
        return float(self.map(image, target).mean())

    def in_regions(self, image: ByteArray, target: ByteArray, masks: Mapping[str, Mask]) -> dict[str, float]:
        """Mean over each (H, W) boolean mask; regions without pixels are left out."""
        check_masks(masks, target)
        error = self.map(image, target)
        return {name: float(error[mask].mean()) for name, mask in masks.items() if mask.any()}

    def map(self, image: ByteArray, target: ByteArray) -> FloatArray:
        """(H, W) float64 error in [0, 1] of each pixel (equation 20)."""
        check_pair(image, target)
        x, y = (_opponent(_linear(array)) for array in (image, target))
        color = _color_error(*(self._seen(array) for array in (x, y)))
        feature = self._feature_error(x[..., 0], y[..., 0])
        return color ** (1 - feature)

    def _seen(self, opponent: FloatArray) -> FloatArray:
        """Section 4.1.1 to 4.1.3: filter by contrast sensitivity, in Lab with the Hunt effect."""
        filters = _sensitivity_filters(self.pixels_per_degree)
        blurred = [blur(np.ascontiguousarray(opponent[..., i])) for i, blur in enumerate(filters)]
        linear = np.clip(_from_opponent(np.stack(blurred, axis=-1)), 0, 1)
        return _appearance(linear)

    def _feature_error(self, luminance: FloatArray, target_luminance: FloatArray) -> FloatArray:
        """Section 4.2: difference of edges and of points, in [0, 1]."""
        x, y = ((np.ascontiguousarray(a) + 16) / 116 for a in (luminance, target_luminance))
        differences = [
            np.abs(_magnitude(x, pair) - _magnitude(y, pair))
            for pair in _feature_filters(self.pixels_per_degree)
        ]
        return (np.maximum(*differences) / math.sqrt(2)) ** _QF


def _linear(image: ByteArray) -> FloatArray:
    """Display-referred sRGB bytes to linear light."""
    levels = np.arange(256) / 255
    table = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    return table[image]


def _opponent(
    linear: FloatArray, curve: Callable[[FloatArray], FloatArray] = lambda light: light
) -> FloatArray:
    """Linear sRGB to the opponent space YCxCz (section 4.1.1), or with a curve for the light to CIELAB."""
    x, y, z = np.moveaxis(curve(linear @ (_TO_XYZ / _WHITE[:, None]).T), -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def _from_opponent(opponent: FloatArray) -> FloatArray:
    """The inverse of `_opponent`."""
    y = (opponent[..., 0] + 16) / 116
    x, z = y + opponent[..., 1] / 500, y - opponent[..., 2] / 200
    return (np.stack([x, y, z], axis=-1) * _WHITE) @ np.linalg.inv(_TO_XYZ).T


def _appearance(linear: FloatArray) -> FloatArray:
    """Linear sRGB to CIELAB with equation 9: the darker a colour, the less colourful it appears."""
    delta = 6 / 29
    lab = _opponent(linear, lambda v: np.where(v > delta**3, np.cbrt(v), v / (3 * delta**2) + 4 / 29))
    lab[..., 1:] *= 0.01 * lab[..., :1]
    return lab


def _color_error(seen: FloatArray, true: FloatArray) -> FloatArray:
    """Sections 4.1.4 and 4.1.5: HyAB distance, compressed and stretched to [0, 1]."""
    largest = _hyab(*(_appearance(np.array(c, dtype=float)) for c in ([0, 1, 0], [0, 0, 1]))) ** _QC
    error = _hyab(seen, true) ** _QC
    knee = _PC * largest
    upper = _PT + (error - knee) / (largest - knee) * (1 - _PT)
    return np.where(error < knee, error * _PT / knee, upper)


def _hyab(a: FloatArray, b: FloatArray) -> FloatArray:
    """Equation 10."""
    difference = a - b
    return np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2])


@functools.cache
def _sensitivity_filters(pixels_per_degree: float) -> tuple[_Filter, _Filter, _Filter]:
    """Equations 5 and 6: one filter per opponent channel, all with the radius of the widest."""
    widest = max(max(b1, b2) for _, b1, _, b2 in _SENSITIVITY)
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * pixels_per_degree)
    squares = (np.arange(-radius, radius + 1) / pixels_per_degree) ** 2

    def made(a1: float, b1: float, a2: float, b2: float) -> _Filter:
        terms = [(a * math.pi / b, np.exp(-(math.pi**2) * squares / b)) for a, b in ((a1, b1), (a2, b2)) if a]
        total = sum(scale * shape.sum() ** 2 for scale, shape in terms)
        # A radial Gaussian is the product of Gaussians of x and y.
        return _Filter(tuple((scale / total * shape, shape) for scale, shape in terms))

    luminance, red_green, blue_yellow = (made(*row) for row in _SENSITIVITY)
    return luminance, red_green, blue_yellow


@functools.cache
def _feature_filters(pixels_per_degree: float) -> tuple[tuple[FloatArray, FloatArray], ...]:
    """Section 4.2: for edges and for points, the weights along an axis and across it."""
    deviation = 0.5 * _FEATURE_WIDTH * pixels_per_degree
    radius = math.ceil(3 * deviation)
    offsets = np.arange(-radius, radius + 1, dtype=np.float64)
    smooth = np.exp(-(offsets**2) / (2 * deviation**2))
    edge, point = -offsets * smooth, (offsets**2 / deviation**2 - 1) * smooth
    return tuple((_balanced(kernel), smooth / smooth.sum()) for kernel in (edge, point))


def _balanced(kernel: FloatArray) -> FloatArray:
    """Positive weights sum to 1, negative ones to -1."""
    positive, negative = kernel[kernel > 0].sum(), -kernel[kernel < 0].sum()
    return np.where(kernel > 0, kernel / positive, kernel / negative)


def _magnitude(channel: FloatArray, pair: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Magnitude of the responses along x and y."""
    along, across = pair
    return np.hypot(_Filter(((across, along),))(channel), _Filter(((along, across),))(channel))


flip = Flip()
