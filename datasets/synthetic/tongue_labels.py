"""From when on a subject's tongue counts as out: by geometry, since heads and tongues differ in size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...bench.contracts import FloatArray
from .anatomy import Anatomy, front_depth
from .mouth import MouthPart

HIDES = 20e-6
"""Square metres of lower lip and chin, seen from straight ahead, that a tongue hides when it is out: 4 x 5 mm."""

_STEP = 0.0005  # metres between lines of sight
_AROUND = np.array(
    [[-0.040, -0.055], [0.040, 0.025]]
)  # metres from the mouth's middle: right below, left above
_BISECTIONS = 7


def share_that_shows(parts: Sequence[MouthPart], anatomy: Anatomy, neutral: FloatArray) -> float:
    """The least ``tongue_out`` at which the tongue among ``parts`` hides `HIDES` of the neutral skin, to 1 %.

    Tongue and lower lip both follow the jaw, so the closed mouth stands for the open one; the upper lip, which
    the tongue would then cross, is left out. Infinity for a subject without a tongue, or with one that stays
    behind the lips.
    """
    tongues = [part for part in parts if part.name == "tongue"]
    low = anatomy["mouth"][:2] + _AROUND[0] * anatomy.scale
    size = np.ceil((_AROUND[1] - _AROUND[0]) * anatomy.scale / _STEP).astype(int)
    skin = front_depth(neutral, anatomy.skin_faces, low, _STEP, size)

    def hidden(share: float) -> float:
        covered = np.zeros(skin.shape, bool)
        for tongue in tongues:
            covered |= front_depth(tongue.at(share), tongue.faces, low, _STEP, size) > skin
        return float((covered & np.isfinite(skin)).sum()) * _STEP**2

    if hidden(1.0) < HIDES:
        return float("inf")
    behind, out = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (behind + out)
        behind, out = (behind, middle) if hidden(middle) >= HIDES else (middle, out)
    return out
