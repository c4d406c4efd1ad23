"""Traits of the subjects: skin tone, age, hair style, beard and glasses."""

from __future__ import annotations

import numpy as np

from ...bench.contracts import FloatArray
from ..head.geometry import smoothstep
from .anatomy import HAIR, IRIS, SKIN, Person, linear
from .hair import STYLES

AGES = (20.0, 78.0)
_GREY = "#c4c0ba"
_SHORT = 0.05  # metres; of longer hair the hairline does not recede
_TRAITS, _BLOCK = 5, 10  # traits that are distributed evenly over every ten subjects


def spread(seed: int, index: int) -> FloatArray:
    """(5,) numbers in [0, 1): a Latin hypercube over every ten subjects of a seed.

    They are skin tone, age, hair style, beard and glasses.
    """
    rng = np.random.default_rng([seed, 21, index // _BLOCK])
    tenths = np.stack([rng.permutation(_BLOCK) for _ in range(_TRAITS)], axis=1)
    return (tenths + rng.random((_BLOCK, _TRAITS)))[index % _BLOCK] / _BLOCK


def draw_person(name: str, index: int, seed: int, dynamics: float = 1.0) -> Person:
    """Draw subject number ``index`` of a capture made with ``seed``."""
    rng = np.random.default_rng([seed, index, 22])
    tone, years, style, growth, eyewear = spread(seed, index)
    age = AGES[0] + (AGES[1] - AGES[0]) * years
    place = tone * (len(SKIN) - 1)
    lower, upper = linear(SKIN[int(place)]), linear(SKIN[int(place) + 1])
    skin = (lower + (place - int(place)) * (upper - lower)) * rng.uniform(0.95, 1.05, 3)
    old = float(smoothstep(age, 35.0, 75.0))
    dark = place > 3.0
    hair = linear(HAIR[rng.integers(0, 2 if dark else len(HAIR) - 1)]) * rng.uniform(0.85, 1.15)
    grey = float(np.clip(smoothstep(age, 38.0, 74.0) + 0.2 * rng.standard_normal() * old, 0.0, 1.0))
    hair = hair + grey * (linear(_GREY) - hair)
    lips = skin * np.array([0.86, 0.50, 0.50]) * rng.uniform(0.9, 1.1)
    lips = lips + 0.35 * old * (0.8 * skin - lips)
    beard = 0.0 if growth < 0.6 else 0.006 if growth < 0.8 else float(rng.uniform(0.012, 0.020))
    worn = tuple(STYLES)[int(style * len(STYLES))]
    recession = (
        float(rng.random() < 0.6) * float(rng.uniform(0.0, 0.045)) * float(smoothstep(age, 28.0, 60.0))
    )
    return Person(
        name=name,
        seed=int(rng.integers(1, 2**31)),
        skin=skin,
        lips=lips,
        hair=hair,
        iris=linear(IRIS[rng.choice([0, 4] if dark else len(IRIS))]),
        style=worn,
        brow_thickness=float(rng.uniform(0.85, 1.25)),
        freckles=float(rng.choice([0.0, 0.0, 0.5, 1.0])) if place < 2.5 else 0.0,
        stubble=1.0 if beard else float(rng.uniform(0.3, 1.0)) if growth > 0.4 else 0.0,
        lines=float(rng.uniform(0.85, 1.2)) * (0.85 + 0.3 * old),
        dynamics=dynamics,
        lines_at_rest=old * float(rng.uniform(0.6, 1.0)),
        oil=float(rng.uniform(0.4, 1.2)) * (1.0 - 0.4 * old),
        sag=float(smoothstep(age, 38.0, 78.0)),
        spots=old * float(rng.uniform(0.2, 1.0)),
        recession=recession if STYLES[worn].length < _SHORT else 0.0,
        beard=beard,
        glasses="" if eyewear < 0.7 else "metal" if eyewear < 0.9 else "plastic",
    )
