"""Hair and the skin of the neck follow the head late, which tracked parameters do not show.

Each follows as a mass on a damped spring, with a transfer function of second order. Hair swings as a rod that hangs from one
end (compare Keller, "Ponytail motion", SIAM Journal on Applied Mathematics 70(7), 2010), so that its frequency follows from its
length. Damping, and both numbers of the neck, are choices, not measurements.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray
from ..rounding import COEFFICIENT_BITS, on_grid
from .performance import Activations, Performed

FOLLOWED = ("head_nod", "head_turn", "head_tilt", "neck_nod", "neck_turn", "sway_x", "sway_y", "sway_z")
"""Controls that hair and neck follow."""
RATE = 73.0
"""Rate at which past controls are sampled, per second: NeRSemble's frame rate."""
_MEMORY = 2.0  # seconds, after which the slowest response is within 1e-3 of its limit
_GRAVITY = 9.81
HAIR_DAMPING = 0.5
NECK_FREQUENCY, NECK_DAMPING = 4.0, 0.3
"""Natural frequency in hertz and damping ratio of the skin of the neck over the muscles."""
NECK_SHARE = 0.3
"""Fraction of the neck's lag in its skin; the tissue below prevents the rest."""
FREE_LENGTH = 0.15
"""Distance from the root, metres, beyond which hair swings freely; closer to the root, head and other hair hold it."""


@dataclass(frozen=True)
class Lagging:
    """Delayed controls at one moment, for hair and for the neck."""

    hair: Activations
    neck: Activations


def hair_frequency(length: float) -> float:
    """Natural frequency, hertz, of a rod of ``length`` metres that hangs from one end."""
    return float(np.sqrt(1.5 * _GRAVITY / length) / (2.0 * np.pi))


def step_response(seconds: FloatArray, frequency: float, damping: float) -> FloatArray:
    """Response to a unit step at 0 of a system of second order, ``damping`` below 1."""
    speed = 2.0 * np.pi * frequency
    swing = speed * np.sqrt(1.0 - damping**2)
    phase = swing * seconds
    return 1.0 - np.exp(-damping * speed * seconds) * (
        np.cos(phase) + damping * speed / swing * np.sin(phase)
    )


def shares(frequency: float, damping: float) -> FloatArray:
    """(K,) weights of the moments (k + 1/2) / `RATE` seconds ago; they sum to 1."""
    reached = step_response(np.arange(round(_MEMORY * RATE) + 1) / RATE, frequency, damping)
    weights = on_grid(np.diff(reached), COEFFICIENT_BITS)
    weights[-1] += 1.0 - weights.sum()
    return weights


def follow(performed: Performed, moment: float, amount: float, length: float) -> Lagging:
    """Delayed controls at a ``moment`` (seconds) for hair of ``length`` metres and for the neck.

    ``amount`` scales the distance to the controls of that moment. Before a sequence the head is still.
    """
    past = performed.curves(np.maximum(moment - (np.arange(round(_MEMORY * RATE)) + 0.5) / RATE, 0.0))
    now = {name: float(values[0]) for name, values in performed.curves(np.array([moment])).items()}

    def late(frequency: float, damping: float) -> Activations:
        # Weights and controls are rounded to grids, so the sums are exact.
        weights = shares(frequency, damping)
        found: Mapping[str, float] = {name: float((weights * past[name]).sum()) for name in FOLLOWED}
        moved = {name: now[name] + amount * (found[name] - now[name]) for name in FOLLOWED}
        return {**now, **moved}

    return Lagging(late(hair_frequency(length), HAIR_DAMPING), late(NECK_FREQUENCY, NECK_DAMPING))
