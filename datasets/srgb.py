"""The sRGB curve."""

from __future__ import annotations

import numpy as np

from ..bench.contracts import FloatArray


def srgb_to_linear(values: FloatArray) -> FloatArray:
    """Decode sRGB in [0, 1] (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
