"""Differentiable Gaussian splat renderer: one function, `rasterize`, with interchangeable backends."""

from .rasterize import available_backends, rasterize
from .reference import pixel_weights
from .request import Rendering

__all__ = ["Rendering", "available_backends", "pixel_weights", "rasterize"]
