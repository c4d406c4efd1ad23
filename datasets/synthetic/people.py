"""Who is photographed: the traits that make one synthetic subject differ from the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray
from ..srgb import srgb_to_linear

# Display colours (sRGB); the skin tones run roughly through Fitzpatrick's types I to VI.
_SKIN = ("#eac6b2", "#e2b49a", "#d3a083", "#b98363", "#8f5f43", "#6a4430")
_HAIR = ("#2a1d16", "#14100e", "#4a3020", "#7b5836", "#b08a56", "#8c4322", "#8f8a86")
_IRIS = ("#5b3a1e", "#3f6f8f", "#6d7f45", "#7d7468", "#3a2414")
STYLES = ("short", "bob", "crop", "swept")


def linear(color: str | FloatArray) -> FloatArray:
    """Display colour (``#rrggbb`` or sRGB in [0, 1]) to linear light, (3,)."""
    if isinstance(color, str):
        color = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return srgb_to_linear(color)


@dataclass(frozen=True, eq=False)
class Person:
    """Traits of one subject. Colours are linear-light RGB.

    ``freckles``, ``stubble`` and ``lines`` (how strongly skin folds) are in [0, 1]-ish shares; ``dynamics`` scales all
    that expressions do to skin beyond moving it: 0 for nothing, 1 as drawn.
    """

    name: str
    seed: int
    skin: FloatArray
    lips: FloatArray
    hair: FloatArray
    iris: FloatArray
    style: str
    brow_thickness: float
    freckles: float
    stubble: float
    lines: float
    dynamics: float = 1.0


def person(name: str, index: int, seed: int, dynamics: float = 1.0) -> Person:
    """Draw subject number ``index`` of a capture made with ``seed``.

    Tones and hair styles walk through their lists, so that a few subjects already differ; the rest is drawn.
    """
    rng = np.random.default_rng([seed, index])
    start = int(np.random.default_rng([seed]).integers(0, 6))
    tone = (start + 2 * index + index // 3) % len(_SKIN)
    skin = linear(_SKIN[tone]) * rng.uniform(0.95, 1.05, 3)
    # Darker skin goes with darker hair and eyes more often than not.
    hair = linear(_HAIR[rng.integers(0, 2 if tone >= 4 else len(_HAIR))]) * rng.uniform(0.85, 1.15)
    iris = linear(_IRIS[rng.choice([0, 4] if tone >= 4 else len(_IRIS))])
    lips = skin * np.array([0.86, 0.50, 0.50]) * rng.uniform(0.9, 1.1)
    return Person(
        name=name,
        seed=int(rng.integers(1, 2**31)),
        skin=skin,
        lips=lips,
        hair=hair,
        iris=iris,
        style=STYLES[(index + start) % len(STYLES)],
        brow_thickness=float(rng.uniform(0.85, 1.25)),
        freckles=float(rng.choice([0.0, 0.3, 1.0])) if tone < 3 else 0.0,
        stubble=float(rng.choice([0.0, 0.5, 1.0])),
        lines=float(rng.uniform(0.85, 1.25)),
        dynamics=dynamics,
    )
