"""Teeth, gums and tongue: modelled around the landmarks of any head, outside the tracked mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray, IntArray
from .anatomy import Anatomy
from .curves import ramp
from .noise import value_noise


@dataclass(frozen=True, eq=False)
class MouthPart:
    """A mesh in the mouth at rest.

    ``vertices`` (n, 3) and ``out`` (n, 3), the same with the tongue put out; ``weights`` (n, J) bind it to the
    joints.
    """

    name: str
    vertices: FloatArray
    out: FloatArray
    faces: IntArray
    albedo: FloatArray
    weights: FloatArray
    material: str

    def at(self, tongue_out: float) -> FloatArray:
        """Rest vertices for a tongue that is out by a share in [0, 1]."""
        return self.vertices + tongue_out * (self.out - self.vertices)
