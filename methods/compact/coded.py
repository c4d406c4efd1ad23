"""Arrays of a compact file, written with a step and taken out again with every size checked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from .container import Content
from .integers import dequantise, quantise


def coded(values: FloatArray, step: FloatArray | float) -> np.ndarray:
    """Small integers for a step above 0, else the float32 numbers themselves."""
    if np.all(np.asarray(step) > 0):
        return quantise(values, step)
    return np.asarray(values, np.float32)


class Arrays:
    """Arrays of a file, each to be taken once. Raises `InputError` where one is missing or of another size."""

    def __init__(self, path: Path, content: Content):
        self.path, self.steps, self.text = path, content.steps, content.text
        self._left: dict[str, np.ndarray] = dict(content.arrays)

    def __contains__(self, name: str) -> bool:
        return name in self._left

    def step(self, name: str) -> float:
        """A step by name."""
        if name not in self.steps:
            raise InputError(self.path, f"steps, {name}", "a number", "none")
        return float(self.steps[name])

    def take(self, name: str, *shape: int | None) -> np.ndarray:
        """The array of a name, of a shape in which None fits any size."""
        if name not in self._left:
            raise InputError(self.path, name, "an array of that name", "none")
        values = self._left.pop(name)
        fits = values.ndim == len(shape) and all(
            want is None or want == has for want, has in zip(shape, values.shape)
        )
        if not fits:
            expected = ", ".join("any" if size is None else str(size) for size in shape)
            raise InputError(self.path, name, f"shape ({expected})", f"shape {values.shape}")
        return values

    def integers(self, name: str, *shape: int | None) -> np.ndarray:
        """The same for whole numbers."""
        values = self.take(name, *shape)
        if values.dtype.kind != "u":
            raise InputError(self.path, name, "whole numbers", str(values.dtype))
        return values

    def floats(self, name: str, *shape: int | None) -> FloatArray:
        """The same for finite float32 numbers."""
        values = self.take(name, *shape)
        if values.dtype.kind != "f" or not np.isfinite(values).all():
            raise InputError(self.path, name, "finite numbers", f"{values.dtype} or non-finite numbers")
        return values.astype(np.float32)

    def decoded(self, name: str, step: FloatArray | float, *shape: int | None) -> FloatArray:
        """What `coded` was given, up to rounding, as float32."""
        if name in self._left and self._left[name].dtype.kind == "f":
            return self.floats(name, *shape)
        return dequantise(self.integers(name, *shape), step)

    def rest(self) -> Mapping[str, FloatArray]:
        """What nobody took: it must be float32 throughout, and is stored as it is."""
        return {name: self.floats(name, *values.shape) for name, values in list(self._left.items())}
