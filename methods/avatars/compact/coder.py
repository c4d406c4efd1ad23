"""Quantisation of an avatar's arrays by their visible effect, the same steps in both directions.

A layout (`layouts`) describes the arrays of a method's avatar once, by calls of a `Coder`, which quantises and stores them, or
reads them back; each call returns the decoded values in both directions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from ....bench.contracts import FloatArray, IntArray
from .precision import Precision

FINEST, COARSEST = -3, 6
"""Limits of the classes of visibility: steps are multiplied by 2^class."""
BASIS_STEP = 1 / 1024
"""Step of a transform's basis relative to the largest number of a row."""
LEAST_GAIN = 10 * 2 * np.log(2) / 12
"""Minimum gain in squared steps for each number of a row of a basis, which takes about 10 bits: at the rate of a fine uniform
quantiser a bit is worth 2 ln 2 / 12."""


Values = Callable[[], np.ndarray]


@dataclass(frozen=True, eq=False)
class CoderInput:
    """What is encoded."""

    tensors: Mapping[str, np.ndarray]
    """Arrays by name; those of the splats in the order in which they are stored."""
    weights: FloatArray | None = None
    """(N,) `importance` of the splats; None: all are equally visible."""
    metrics: Mapping[str, FloatArray] = field(default_factory=dict)
    """Symmetric positive matrices M by name of vectors: an error e of a vector has the visible squared error e M e. The
    identity for others."""


class Coder:
    """Encodes arrays of a `CoderInput`, or decodes those of a file.

    ``values`` of a call are encoded instead of the array of that name in the source. Decoding raises KeyError for a missing
    array and ValueError for arrays that do not fit each other. ``parts`` has the part of each encoded array: a name of a step of
    `Precision`, or "other".
    """

    def __init__(
        self, precision: Precision, text: Mapping[str, str], given: CoderInput | Mapping[str, np.ndarray]
    ):
        self.precision, self.text = precision, text
        self.source = given if isinstance(given, CoderInput) else None
        self.arrays: dict[str, np.ndarray] = {} if isinstance(given, CoderInput) else dict(given)
        self.parts: dict[str, str] = {}
        self._taken: set[str] = set()

    @property
    def left(self) -> list[str]:
        """Names of arrays of the source that no call took; decoding: of the file."""
        names = self.arrays if self.source is None else self.source.tensors
        return [name for name in names if name not in self._taken]

    def has(self, name: str) -> bool:
        """Whether there is an array of a name."""
        return name in (self.arrays if self.source is None else self.source.tensors)

    def given(self, name: str) -> np.ndarray:
        """The array of a name of the source. It counts as taken."""
        assert self.source is not None
        self._taken.add(name)
        return self.source.tensors[name]

    def _values(self, name: str, values: Values | None) -> np.ndarray | None:
        if self.source is None:
            return None
        return np.asarray(self.given(name) if values is None else values())

    def _pass(self, name: str, values: np.ndarray | None, part: str) -> np.ndarray:
        """Store an array, or read it if there are no ``values``."""
        self._taken.add(name)
        if values is not None:
            self.arrays[name], self.parts[name] = values, part
        return self.arrays[name]

    def _floats(self, name: str, values: np.ndarray | None, part: str) -> FloatArray:
        found = self._pass(name, None if values is None else values.astype(np.float32), part)
        if found.dtype.kind != "f":
            raise ValueError(f"{name} has whole numbers")
        return found

    def _levels(self, name: str, values: np.ndarray | None, part: str) -> IntArray:
        """Whole numbers below 2^30; others are rounded."""
        if values is not None:
            values = np.rint(values.astype(np.float64)).clip(-(2**30), 2**30 - 1).astype(np.int64)
        found = self._pass(name, values, part)
        if found.dtype.kind != "i":
            raise ValueError(f"{name} has no whole numbers")
        return found

    def exact(self, name: str, values: Values | None = None, part: str = "other") -> FloatArray:
        """An array as float32."""
        return self._floats(name, self._values(name, values), part)

    def whole(self, name: str, values: Values | None = None, part: str = "other") -> IntArray:
        """An array of whole numbers below 2^30."""
        return self._levels(name, self._values(name, values), part)

    def rounded(
        self,
        name: str,
        part: str,
        unit: FloatArray | float = 1.0,
        base: FloatArray | float = 0.0,
        values: Values | None = None,
    ) -> FloatArray:
        """An array rounded to multiples of the part's step times ``unit`` from ``base``, float32; exact for step 0."""
        if not (step := getattr(self.precision, part)):
            return self.exact(name, values, part)
        found, steps = self._values(name, values), step * np.asarray(unit, np.float64)
        found = None if found is None else (found.astype(np.float64) - base) / steps
        return (_times(self._levels(name, found, part), steps) + base).astype(np.float32)

    def matrix(self, name: str, part: str, step: float, values: FloatArray | None = None) -> FloatArray:
        """Weights with a row for each output, rounded relative to the largest of their row; exact for step 0."""
        found = self._values(name, None) if values is None else values
        if not step:
            return self._floats(name, found, part)
        steps = None
        if found is not None:
            largest = step * np.abs(found).max(tuple(range(1, found.ndim)), initial=0, keepdims=True)
            steps = np.where(largest > 0, largest, 1.0)
        steps = self._floats(f"{name}/steps", steps, part).astype(np.float64)
        levels = self._levels(name, None if found is None else found / steps, part)
        return _times(levels, steps).astype(np.float32)

    def vectors(
        self,
        name: str,
        part: str,
        step: float | None = None,
        *,
        scale: FloatArray | float = 1.0,
        units: FloatArray | None = None,
        values: Values | None = None,
        weights: FloatArray | None = None,
    ) -> FloatArray:
        """(N, C) vectors through a Karhunen-Loeve transform (V. Goyal, IEEE Signal Processing Magazine 18(5), 2001): in
        coordinates in which equal errors are equally visible and different ones are uncorrelated, one step serves all.

        - ``step``: step of the root of the visible squared error; by default that of the part.
        - ``scale``: (N, 1) factors of the step.
        - ``units``: (N, W) units of the numbers, repeated along the columns; where one is 0, the vectors are exact.
        - ``weights``: to encode: (N,) weights of the vectors in the statistics; by default, those of the splats.
        """
        step = getattr(self.precision, part) if step is None else step
        if not step or (units is not None and not units.all()):
            return self.exact(name, values, part)
        basis = chosen = None
        if self.source is not None:
            given = np.asarray(self._values(name, values), np.float64)
            given = given / _columns(units, given.shape[1])
            metric = self.source.metrics.get(name, np.eye(given.shape[1]))
            shares = self.source.weights if weights is None else weights
            if shares is None or not shares.sum() > 0:
                shares = np.ones(len(given))
            basis, chosen = _transformed(given, metric, shares / max(shares.sum(), 1e-30), step * scale)
        basis = self.matrix(f"{name}/basis", part, BASIS_STEP, basis).astype(np.float64)
        found = _times(self._levels(name, chosen, part), step * scale) @ basis
        return (found * _columns(units, found.shape[1])).astype(np.float32)


def _times(levels: IntArray, steps: FloatArray | float) -> FloatArray:
    if np.ndim(steps) and np.shape(steps)[0] != len(levels):
        raise ValueError(f"{len(levels)} rows of numbers, but {np.shape(steps)[0]} of steps")
    return levels * np.asarray(steps)


def _columns(units: FloatArray | None, count: int) -> FloatArray | float:
    return 1.0 if units is None else units[:, np.arange(count) % units.shape[1]]


def _transformed(
    values: FloatArray, metric: FloatArray, shares: FloatArray, steps: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Rows of the basis, and the levels of the coordinates that are worth more than their row."""
    parts, axes = np.linalg.eigh(np.asarray(metric, np.float64))
    parts = np.maximum(parts, 1e-8 * max(float(parts.max(initial=0)), 1e-12))
    visible, back = (axes * np.sqrt(parts)) @ axes.T, (axes / np.sqrt(parts)) @ axes.T
    seen = values @ visible
    directions = np.linalg.eigh((seen * shares[:, None]).T @ seen)[1][:, ::-1]
    coordinates = seen @ directions / steps
    chosen = np.rint(coordinates)
    gain = (coordinates**2 - (coordinates - chosen) ** 2).sum(0)
    kept = gain > LEAST_GAIN * values.shape[1]
    return (directions.T @ back)[kept], chosen[:, kept]


def visibility_classes(weights: FloatArray | None, count: int) -> IntArray:
    """(N,) classes of visibility, `FINEST` to `COARSEST`, of (N,) mean squared errors per unit of squared error; 0 without.

    The class of an average weight is 0. An error in a class is half as visible as in the class before, so that twice the step
    gives the same mean squared error in the picture.
    """
    if weights is None or not len(weights) or not (mean := float(np.mean(weights, dtype=np.float64))) > 0:
        return np.zeros(count, np.int64)
    ratio = np.maximum(weights / mean, 2.0 ** (-2 * COARSEST - 2))
    return np.clip(np.rint(-0.5 * np.log2(ratio)), FINEST, COARSEST).astype(np.int64)


def scale_of(classes: IntArray, coarsest: int = COARSEST) -> FloatArray:
    """(N, 1) factors of steps."""
    return np.exp2(np.minimum(classes, coarsest).astype(np.float64))[:, None]
