"""Quantisation of an avatar's arrays by their visible effect, the same steps in both directions.

A layout (`layouts`) describes the arrays of a method's avatar once, by calls of a `Coder`, which quantises and stores them, or
reads them back; each call returns the decoded values in both directions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ....bench.contracts import FloatArray, IntArray
from .container import MOST_NUMBERS, Content
from .precision import Precision

FINEST, COARSEST = -3, 6
"""Limits of the classes of visibility: steps are multiplied by 2^class."""
RATE_WEIGHT = 2 * np.log(2) / 12
"""Lagrangian weight of a bit, in squared steps: the slope of a fine uniform quantiser, 2 ln 2 / 12."""
BASIS_STEP, BASIS_BITS = 1 / 1024, 10
"""Step of a transform's basis relative to the largest number of a row, and bits of a number."""


@dataclass(frozen=True, eq=False)
class Source:
    """What is encoded.

    Attributes
    ----------
    tensors : Mapping[str, np.ndarray]
        Arrays by name; those of the splats in the order in which they are stored.
    weights : FloatArray | None
        (N,) `importance` of the splats; None: all are equally visible.
    metrics : Mapping[str, FloatArray]
        Metrics of vectors by name, see `Coder.vectors`.
    """

    tensors: Mapping[str, np.ndarray]
    weights: FloatArray | None = None
    metrics: Mapping[str, FloatArray] = field(default_factory=dict)


class Coder:
    """Encodes arrays of a `Source`, or decodes those of a `Content`.

    Decoding raises KeyError for a missing array and ValueError for arrays that do not fit each other.

    Attributes
    ----------
    parts : dict[str, str]
        Part of the file of each array that was encoded: a name of a step of `Precision`, or "other".
    """

    def __init__(
        self, precision: Precision, text: Mapping[str, str], given: Source | Mapping[str, np.ndarray]
    ):
        self.precision, self.text = precision, text
        self.source = given if isinstance(given, Source) else None
        self.arrays: dict[str, np.ndarray] = {} if isinstance(given, Source) else dict(given)
        self.parts: dict[str, str] = {}
        self._taken: set[str] = set()

    @classmethod
    def of(cls, content: Content) -> Coder:
        """Decoder of the content of a file."""
        return cls(Precision(**content.steps), content.text, content.arrays)

    @property
    def left(self) -> list[str]:
        """Names of arrays of the source that no call took; decoding: of the file."""
        names = self.arrays if self.source is None else self.source.tensors
        return [name for name in names if name not in self._taken]

    def has(self, name: str, coded: str = "") -> bool:
        """Whether there is an array of a name; ``coded`` is its name in the file if it differs."""
        return name in self.source.tensors if self.source is not None else (coded or name) in self.arrays

    def given(self, name: str) -> FloatArray:
        """The array of a name to encode. It counts as taken."""
        assert self.source is not None
        self._taken.add(name)
        return np.asarray(self.source.tensors[name])

    def _pass(self, name: str, values: np.ndarray | None, part: str) -> np.ndarray:
        """Store an array, or read it if there are no ``values``."""
        self._taken.add(name)
        if values is not None:
            self.arrays[name], self.parts[name] = values, part
        return self.arrays[name]

    def exact(self, name: str, values: FloatArray | None = None, part: str = "other") -> FloatArray:
        """An array as float32, that of the source if no ``values`` are given."""
        if self.source is not None:
            values = np.asarray(self.given(name) if values is None else values, np.float32)
        return np.asarray(self._pass(name, values, part), np.float32)

    def whole(self, name: str, values: np.ndarray | None = None, part: str = "other") -> IntArray:
        """An array of whole numbers, that of the source if no ``values`` are given."""
        if self.source is not None:
            values = np.asarray(self.given(name) if values is None else values).astype(np.int64)
        found = self._pass(name, values, part)
        if found.dtype.kind != "i":
            raise ValueError(f"{name} has no whole numbers")
        return found

    def rounded(
        self,
        name: str,
        part: str,
        unit: FloatArray | float = 1.0,
        base: FloatArray | float = 0.0,
        values: FloatArray | None = None,
    ) -> FloatArray:
        """An array rounded to multiples of the part's step times ``unit`` from ``base``, float32; exact for step 0."""
        if not (step := getattr(self.precision, part)):
            return self.exact(name, values, part)
        steps = step * np.asarray(unit, np.float64)
        levels = None
        if self.source is not None:
            away = (self.given(name) if values is None else np.asarray(values)) - np.asarray(base, np.float64)
            levels = _nearest(away / steps)
        return (self.whole(name, levels, part) * steps + base).astype(np.float32)

    def matrix(self, name: str, step: float, part: str, values: FloatArray | None = None) -> FloatArray:
        """Weights with a row for each output, rounded relative to the largest of their row."""
        if not step:
            return self.exact(name, values, part)
        steps = chosen = None
        if self.source is not None:
            values = self.given(name) if values is None else values
            rows = values.reshape(len(values), -1).astype(np.float64)
            largest = np.abs(rows).max(1, initial=0)
            steps = np.where(largest > 0, step * largest, 1.0).astype(np.float32)
            chosen = _nearest(rows / steps[:, None]).reshape(values.shape)
        steps = self.exact(f"{name}/steps", steps, part)
        found = self.whole(name, chosen, part)
        return (found * steps.reshape(-1, *[1] * (found.ndim - 1)).astype(np.float64)).astype(np.float32)

    def vectors(
        self,
        name: str,
        part: str,
        step: float | None = None,
        *,
        scale: FloatArray | float = 1.0,
        units: FloatArray | None = None,
        values: FloatArray | None = None,
        metric: FloatArray | None = None,
        weights: FloatArray | None = None,
        centred: bool = True,
    ) -> FloatArray:
        """(N, C) vectors through a Karhunen-Loeve transform: in coordinates in which equal errors are equally visible and
        different ones are uncorrelated, one step serves all (V. Goyal, "Theoretical foundations of transform coding", IEEE
        Signal Processing Magazine 18(5), 2001).

        Parameters
        ----------
        step : float | None
            Step of the root of the visible squared error; by default that of the part.
        scale : FloatArray | float
            (N, 1) factors of the step.
        units : FloatArray | None
            (N, W) units of the numbers, repeated along the columns; where one is 0, the vectors are exact.
        values, weights : FloatArray | None
            To encode: the vectors, and their (N,) weights in the statistics; by default, those of the splats.
        metric : FloatArray | None
            To encode: (C, C) symmetric positive matrix M; an error e has the visible squared error e M e. By default that of
            the source or the identity.
        centred : bool
            Whether the mean is subtracted; without, vectors that round to 0 are decoded as 0.
        """
        step = getattr(self.precision, part) if step is None else step
        if not step or (units is not None and not units.all()):
            return self.exact(name, values, part)
        basis = mean = chosen = None
        if self.source is not None:
            values = np.asarray(self.given(name) if values is None else values, np.float64)
            values = values / _columns(units, values.shape[1])
            metric = self.source.metrics.get(name, np.eye(values.shape[1])) if metric is None else metric
            shares = self.source.weights if weights is None else weights
            if shares is None or not shares.sum() > 0:
                shares = np.ones(len(values))
            shares = shares[:, None] / max(shares.sum(), 1e-30)
            mean = ((shares * values).sum(0) * centred).astype(np.float32)
            basis, chosen = _transformed(values - mean, metric, shares, step * scale)
        basis = self.matrix(f"{name}/basis", BASIS_STEP, part, basis)
        mean = self.exact(f"{name}/mean", mean, part)
        coordinates = self.whole(name, chosen, part) * (step * scale)
        if len(coordinates) * len(mean) > MOST_NUMBERS:
            raise ValueError(f"{name} has {len(coordinates)} vectors of {len(mean)} numbers")
        found = coordinates @ basis.astype(np.float64) + mean
        return (found * _columns(units, len(mean))).astype(np.float32)

    def classes(self, name: str = "classes", weights: FloatArray | None = None, count: int = 0) -> IntArray:
        """Classes of visibility, see `visibility_classes`."""
        values = None if self.source is None else visibility_classes(weights, count)
        return self.whole(name, values, "classes").clip(FINEST, COARSEST)


def _columns(units: FloatArray | None, count: int) -> FloatArray | float:
    return 1.0 if units is None else units[:, np.arange(count) % units.shape[1]]


def _transformed(
    values: FloatArray, metric: FloatArray, shares: FloatArray, steps: FloatArray | float
) -> tuple[FloatArray, IntArray]:
    """Rows of the basis, and the levels of the coordinates that are worth more than their row."""
    parts, axes = np.linalg.eigh(np.asarray(metric, np.float64))
    parts = np.maximum(parts, 1e-8 * max(float(parts.max(initial=0)), 1e-12))
    visible, back = (axes * np.sqrt(parts)) @ axes.T, (axes / np.sqrt(parts)) @ axes.T
    seen = values @ visible
    directions = np.linalg.eigh((seen * shares).T @ seen)[1][:, ::-1]
    coordinates = seen @ directions / steps
    chosen = _nearest(coordinates)
    gain = (coordinates**2 - (coordinates - chosen) ** 2).sum(0)
    kept = gain > RATE_WEIGHT * BASIS_BITS * values.shape[1]
    return (directions.T @ back)[kept], chosen[:, kept]


def _nearest(values: FloatArray) -> FloatArray:
    """The nearest whole numbers, at most 2^30."""
    return np.rint(values).clip(-(2**30), 2**30 - 1)


def visibility_classes(weights: FloatArray | None, count: int) -> IntArray:
    """(N,) classes of visibility, `FINEST` to `COARSEST`, of (N,) mean squared errors per unit of squared error; 0 without.

    The class of an average weight is 0. An error in a class is half as visible as in the class before, so that twice the step
    gives the same mean squared error in the picture.
    """
    if weights is None or not len(weights) or not (mean := float(np.mean(weights, dtype=np.float64))) > 0:
        return np.zeros(count, np.int64)
    ratio = np.maximum(np.asarray(weights, np.float64) / mean, 2.0 ** (-2 * COARSEST - 2))
    return np.clip(np.rint(-0.5 * np.log2(ratio)), FINEST, COARSEST).astype(np.int64)


def scale_of(classes: IntArray, coarsest: int = COARSEST) -> FloatArray:
    """(N, 1) factors of steps."""
    return np.exp2(np.minimum(classes, coarsest).astype(np.float64))[:, None]


def smallest_three(quats: FloatArray) -> FloatArray:
    """(N, 3) imaginary parts of quaternions (w, x, y, z) that turn a Gaussian as the given ones do, with w largest.

    Half a turn about an axis of a Gaussian and the sign of its quaternion do not change it; one of these changes moves
    the largest component to the front and makes it positive. Neither its index nor its sign needs to be stored, and no
    stored component exceeds 1/sqrt(2).
    """
    unit = np.asarray(quats, np.float64)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    w, x, y, z = unit.T
    # q, q i, q j, q k (Hamilton): half turns about the splat's own axes.
    turns = (w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)
    turned = np.stack([np.stack(q, axis=1) for q in turns])
    best = np.abs(turned[:, :, 0]).argmax(0)
    chosen = turned[best, np.arange(len(unit))]
    return chosen[:, 1:] * np.where(chosen[:, :1] < 0, -1.0, 1.0)


def from_smallest_three(imaginary: FloatArray) -> FloatArray:
    """(N, 4) unit quaternions of (N, 3) imaginary parts; float32."""
    parts = np.asarray(imaginary, np.float64)
    real = np.sqrt(np.maximum(1 - (parts**2).sum(1, keepdims=True), 0))
    quats = np.concatenate([real, parts], axis=1)
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)
