"""Rounding to a grid of powers of two, so that all x86-64 machines give the same values.

The last digits of exp, sin, decompositions and long sums depend on instruction set, BLAS and threads. Values of a
synthetic capture are rounded when computed, at least a thousand times coarser than those digits; products and sums of
such numbers within the 53 bits of a float64 are then exact in any order.
"""

from __future__ import annotations

import numpy as np

from ..bench.contracts import FloatArray

LENGTH_BITS = 27
"""Grid of positions and displacements: 2**-27 m, or 7 nm."""
SHARE_BITS = 24
"""Grid of skinning weights, 6e-8; float32 holds no finer one at 1."""
REGRESSOR_BITS = 30
"""Grid of a joint regressor, whose rows have hundreds of entries of about 0.01."""
COEFFICIENT_BITS = 20
"""Grid of coefficients, of activations in [0, 1] or of standard deviations: 1e-6."""
ANGLE_BITS = 30
"""Grid of rotation matrices and of angles in radians: 1e-9, which moves no pixel by 1e-5."""


def share_left(seconds: FloatArray | float, constant: float) -> FloatArray:
    """Fraction of a difference that remains after ``seconds``, 1/e after ``constant``; rounded to the grid of coefficients."""
    return on_grid(np.exp(-np.asarray(seconds) / constant), COEFFICIENT_BITS)


def on_grid(values: FloatArray | float, bits: int) -> FloatArray:
    """Round to the nearest multiples of 2**-bits, ties to even; zeros come out positive."""
    scale = 2.0**bits
    rounded: FloatArray = np.round(np.asarray(values, np.float64) * scale) / scale + 0.0
    return rounded
