"""Quantisation of vectors by their visible error: a Karhunen-Loeve transform, and a choice of levels by rate and distortion.

Transform coding after V. Goyal, "Theoretical foundations of transform coding", IEEE Signal Processing Magazine 18(5), 2001:
in coordinates in which equal errors are equally visible and different ones are uncorrelated, one step serves all.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ....bench.contracts import FloatArray, IntArray
from ....bench.errors import InputError
from .container import Arrays, dequantise, fold, narrow

RATE_WEIGHT = 2 * np.log(2) / 12
"""Lagrangian weight of a bit, in squared steps: the slope of a fine uniform quantiser, 2 ln 2 / 12."""
BASIS_BITS = 16
MOST_NUMBERS = 2**25
"""Maximum of all numbers of decoded vectors, which may take no bytes: 83,000 splats with 20 blendshapes of 10 numbers are half."""
FINEST, COARSEST = -3, 6
"""Limits of the classes of visibility: steps are multiplied by 2^class."""


def visibility_classes(weights: FloatArray | None, count: int) -> IntArray:
    """(N,) classes of visibility, `FINEST` to `COARSEST`, of (N,) mean squared errors per unit of squared error; 0 without.

    The class of an average weight is 0. An error in a class is half as visible as in the class before, so that twice the step
    gives the same mean squared error in the picture.
    """
    if weights is None or not len(weights) or not (mean := float(np.mean(weights, dtype=np.float64))) > 0:
        return np.zeros(count, np.int64)
    ratio = np.maximum(np.asarray(weights, np.float64) / mean, 2.0 ** (-2 * COARSEST - 2))
    return np.clip(np.rint(-0.5 * np.log2(ratio)), FINEST, COARSEST).astype(np.int64)


def store_classes(classes: IntArray) -> np.ndarray:
    """Classes as uint8."""
    return (classes - FINEST).astype(np.uint8)


def read_classes(arrays: Arrays, name: str, count: int | None) -> IntArray:
    """Inverse of `store_classes` for an array of a file."""
    return np.minimum(arrays.integers(name, count).astype(np.int64) + FINEST, COARSEST)


def scale_of(classes: IntArray, coarsest: int = COARSEST) -> FloatArray:
    """(N,) factors of steps."""
    return np.exp2(np.minimum(classes, coarsest).astype(np.float64))


def levels(values: FloatArray, rounds: int = 3) -> IntArray:
    """Rate-distortion optimised quantisation of values in units of steps (`RATE_WEIGHT`).

    For each value the nearest level, the next one towards 0, and 0 are compared, with the bits that the levels of all values
    take; these are estimated from the choice before, ``rounds`` times.
    """
    nearest = np.rint(values).clip(-(2**30), 2**30 - 1).astype(np.int64)
    options = np.stack([nearest, nearest - np.sign(nearest), np.zeros_like(nearest)])
    error = (options - values) ** 2
    chosen = nearest
    for _ in range(rounds):
        present, counts = np.unique(chosen, return_counts=True)
        bits = np.log2(len(chosen) + 1) - np.log2(counts)
        where = np.searchsorted(present, options).clip(0, max(len(present) - 1, 0))
        rate = (
            np.where(present[where] == options, bits[where], np.log2(len(chosen) + 1) + 8.0)
            if len(present)
            else error
        )
        chosen = np.take_along_axis(options, (error + RATE_WEIGHT * rate).argmin(0)[None], 0)[0]
    return chosen


def encode_vectors(
    name: str,
    values: FloatArray,
    metric: FloatArray,
    step: float,
    classes: IntArray,
    weights: FloatArray | None,
    *,
    centred: bool = True,
) -> dict[str, np.ndarray]:
    """Arrays ``name``, ``name_basis`` and ``name_mean`` of vectors.

    Parameters
    ----------
    values : FloatArray
        (N, C) vectors.
    metric : FloatArray
        (C, C) symmetric positive matrix M; an error e has the visible squared error e M e.
    step : float
        Step of the root of the visible squared error, for class 0.
    classes, weights : IntArray, FloatArray | None
        (N,) classes of the vectors, and their weights in the statistics of the transform.
    centred : bool
        Whether the mean is subtracted; without, vectors that round to 0 are decoded as 0.
    """
    values = np.asarray(values, np.float64)
    parts, axes = np.linalg.eigh(np.asarray(metric, np.float64))
    parts = np.maximum(parts, 1e-8 * max(float(parts.max(initial=0)), 1e-12))
    visible, back = (axes * np.sqrt(parts)) @ axes.T, (axes / np.sqrt(parts)) @ axes.T
    shares = np.ones(len(values)) if weights is None else np.asarray(weights, np.float64)
    shares = (
        shares / shares.sum()
        if len(shares) and shares.sum() > 0
        else np.full(len(values), 1 / max(len(values), 1))
    )
    mean = ((shares[:, None] * values).sum(0) * centred).astype(np.float32)
    seen = (values - mean) @ visible
    _, directions = np.linalg.eigh((seen * shares[:, None]).T @ seen)
    directions = directions[:, ::-1]
    coordinates = seen @ directions / (step * scale_of(classes))[:, None]
    chosen = np.stack([levels(column) for column in coordinates.T])
    gain = (coordinates**2 - (coordinates - chosen.T) ** 2).sum(0)
    kept = gain > RATE_WEIGHT * BASIS_BITS * values.shape[1]
    basis = (directions.T @ back)[kept]
    return {
        name: narrow(fold(chosen[kept])),
        f"{name}_basis": basis.astype(
            np.float16 if BASIS_BITS == 16 and np.abs(basis).max(initial=0) < 1e4 else np.float32
        ),
        f"{name}_mean": mean,
    }


def decode_vectors(arrays: Arrays, name: str, step: float, classes: IntArray) -> FloatArray:
    """(N, C) vectors of `encode_vectors`, float32. Raises `InputError` where the arrays do not fit."""
    mean = arrays.floats(f"{name}_mean", None)
    if len(mean) * len(classes) > MOST_NUMBERS:
        expected = f"at most {MOST_NUMBERS} numbers"
        raise InputError(arrays.path, f"{name}_mean", expected, f"{len(classes)} vectors of {len(mean)}")
    basis = arrays.floats(f"{name}_basis", None, len(mean))
    whole = arrays.integers(name, len(basis), len(classes))
    coordinates = dequantise(whole, step * scale_of(classes)[None]).astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        return (coordinates.T @ basis.astype(np.float64) + mean).astype(np.float32)


def has_vectors(arrays: Arrays | Mapping[str, np.ndarray], name: str) -> bool:
    """Whether a file has the vectors of a name."""
    return f"{name}_basis" in arrays
