"""Numbers every backend shares, so that they draw the same image. All are gsplat's."""

from __future__ import annotations

import numpy as np

TILE = 16
"""Side of the square tiles splats are sorted into, pixels."""

ALPHA_MIN = 1.0 / 255.0
"""A splat contributes nothing to pixels where its alpha is below this."""

ALPHA_MAX = float(np.float32(0.99))
"""Alpha is clamped here; the gradient through the clamp is zero.

It is the float32 number in float64 too. What two opaque splats let through is then below `TRANSMITTANCE_MIN` in either
precision, while 0.99 itself in float64 would let a second one be drawn that float32, gsplat's precision, leaves out.
"""

TRANSMITTANCE_MIN = 1e-4
"""The splat that would bring a pixel's transmittance to this or below is left out, with all behind it."""

FRUSTUM_MARGIN = 0.3
"""Ray slopes in the projection's Jacobian are clamped to the image widened by this part of its half size."""

QUATERNION_MIN = 1e-12
"""Quaternions are divided by their norm, or by this if the norm is smaller (zero gives the identity)."""

RADIUS_MAX = float(2**24)
"""Splats reaching further than this, in pixels, are culled: float32 no longer resolves them."""

CHANNELS_MAX = 32
"""Most colour channels one call renders."""
