"""Numbers to small non-negative integers and back."""

from __future__ import annotations

import numpy as np

from ...bench.contracts import FloatArray


def quantise(values: FloatArray, step: FloatArray | float) -> np.ndarray:
    """Round to multiples of ``step`` (broadcast) and fold the signs: 0, -1, 1, -2, ... become 0, 1, 2, 3, ...

    Returns the smallest of uint8, uint16, uint32 that holds them all; beyond 31 bits values are clamped.
    """
    whole = np.rint(np.asarray(values, np.float64) / step).clip(-(2**30), 2**30 - 1).astype(np.int64)
    return narrow(np.where(whole < 0, -2 * whole - 1, 2 * whole))


def dequantise(folded: np.ndarray, step: FloatArray | float) -> FloatArray:
    """The multiples of ``step`` that `quantise` rounded to, float32."""
    wide = folded.astype(np.int64)
    whole = np.where(wide % 2 == 1, -(wide + 1) // 2, wide // 2)
    with np.errstate(over="ignore"):  # what overflows becomes infinite and is refused with all such numbers
        return (whole * np.asarray(step, np.float64)).astype(np.float32)


def narrow(values: np.ndarray) -> np.ndarray:
    """Non-negative integers in the smallest unsigned type of 1, 2 or 4 bytes."""
    top = int(values.max(initial=0))
    return values.astype(np.uint8 if top < 2**8 else np.uint16 if top < 2**16 else np.uint32)


def smallest_three(quats: FloatArray) -> FloatArray:
    """(N, 3) imaginary parts of quaternions (w, x, y, z) that turn a Gaussian as the given ones do, with w largest.

    A Gaussian looks the same after half a turn about any of its axes, and the quaternion's sign never matters; one of
    these changes brings the largest component to the front and makes it positive. So neither its number nor its sign
    needs to be stored, and no component that is stored exceeds 1/sqrt(2).
    """
    unit = np.asarray(quats, np.float64)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    w, x, y, z = unit.T
    # q, q i, q j, q k (Hamilton): half turns about the splat's own axes.
    turned = np.stack(
        [np.stack(q, axis=1) for q in ((w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w))]
    )
    best = np.abs(turned[:, :, 0]).argmax(0)
    chosen = turned[best, np.arange(len(unit))]
    return chosen[:, 1:] * np.where(chosen[:, :1] < 0, -1.0, 1.0)


def from_smallest_three(imaginary: FloatArray) -> FloatArray:
    """(N, 4) unit quaternions of (N, 3) imaginary parts; float32."""
    parts = np.asarray(imaginary, np.float64)
    real = np.sqrt(np.maximum(1 - (parts**2).sum(1, keepdims=True), 0))
    quats = np.concatenate([real, parts], axis=1)
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)
