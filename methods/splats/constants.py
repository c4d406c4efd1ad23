"""Constants shared by all backends, so that they draw the same image. All values are gsplat's."""

from __future__ import annotations

import numpy as np

TILE = 16
"""Side of the square tiles splats are sorted into, pixels."""

ALPHA_MIN = 1.0 / 255.0
"""A splat does not contribute to pixels where its alpha is below this."""

ALPHA_MAX = float(np.float32(0.99))
"""Alpha is clamped here; the gradient through the clamp is zero.

It is the float32 number also in float64. The transmittance of two opaque splats is then below `TRANSMITTANCE_MIN` in
either precision, whereas with 0.99 in float64 a second one would be drawn that float32, gsplat's precision, skips.
"""

TRANSMITTANCE_MIN = 1e-4
"""The splat that would reduce a pixel's transmittance to this or below is skipped, with all behind it."""

FRUSTUM_MARGIN = 0.3
"""Ray slopes in the projection's Jacobian are clamped to the image, extended by this fraction of its half size."""

QUATERNION_MIN = 1e-12
"""Minimum norm by which quaternions are divided (zero gives the identity)."""

RADIUS_MAX = float(2**24)
"""Splats with a larger extent, in pixels, are culled because float32 does not resolve them."""

CHANNELS_MAX = 32
"""Maximum number of colour channels of one call."""
