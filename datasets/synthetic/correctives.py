"""Corrective shapes of a subject that are not in the basis of the tracked head.

Faces are not linear in their controls: the effect of two together is not the sum of both. A corrective is a
smooth displacement of the skin where its controls act, different for each subject, and is driven by the product of two controls
or by the square of one. Images show it. The tracked mesh does not, even with exact tracking: the component of a
corrective in the span of the head model's basis is removed, so no coefficients come closer to the skin.
"""

from __future__ import annotations

import numpy as np

from ...bench.contracts import FloatArray
from ..head.arrays import HeadArrays, region
from ..rounding import LENGTH_BITS, on_grid
from .anatomy import SIDES, Anatomy, Person
from .fields import value_noise
from .performance import EXPRESSION_CONTROLS, Activations, Translation
from .volume import without_joints

DRIVERS: tuple[tuple[str, str], ...] = (
    *((f"smile_{side}", "jaw_open") for side in SIDES),
    *((f"cheek_raise_{side}", f"smile_{side}") for side in SIDES),
    *((f"nose_sneer_{side}", f"upper_lip_up_{side}") for side in SIDES),
    ("brow_inner_up", "brow_outer_up_left"),
    ("brow_down_left", "brow_down_right"),
    ("mouth_frown", "chin_raise"),
    ("funnel", "jaw_open"),
    ("pucker", "pucker"),
    ("cheek_puff", "cheek_puff"),
)
"""Two controls whose product drives a corrective; the same one twice is its square."""
FACE_MM = 0.75
"""Root mean square displacement of the face by each corrective at level 1, where both of its controls are 1. A choice in the
range of the errors of trackers."""
_BROAD = 0.2
"""Fraction of the largest displacement by its controls at which a corrective has half its strength."""
_PERIOD = 0.04
"""Metres between the lattice points of a field, for a head of average size."""


def strengths(activations: Activations) -> FloatArray:
    """(C,) products of the controls that drive the correctives."""
    return np.array([activations[first] * activations[second] for first, second in DRIVERS])


def make_correctives(
    person: Person, anatomy: Anatomy, head: HeadArrays, neutral: FloatArray, translation: Translation
) -> FloatArray:
    """(C, V, 3) displacements, metres, of a subject's neutral vertices (V, 3) at level 1; joints do not move."""
    skin = np.zeros(len(neutral), bool)
    skin[anatomy.skin_faces] = True
    basis = np.asarray(head.expression_basis, np.float64)
    face = np.intersect1d(region(head, "face"), np.flatnonzero(skin))
    made = []
    for number, pair in enumerate(DRIVERS):
        rows = [EXPRESSION_CONTROLS.index(name) for name in pair if name in EXPRESSION_CONTROLS]
        moved = np.linalg.norm(basis @ translation.expression[rows].sum(axis=0), axis=1)
        where = neutral / (_PERIOD * anatomy.scale)
        noise = [value_noise(where + 31.7 * axis, person.seed + 120 + number) for axis in range(3)]
        reach = np.where(skin, moved / (moved + _BROAD * moved[skin].max()), 0.0)
        field = _beyond(basis, reach[:, None] * np.stack(noise, axis=1), skin)
        amount = on_grid(1e-3 * FACE_MM / np.sqrt((field[face] ** 2).sum(axis=1).mean()), LENGTH_BITS)
        made.append(without_joints(head, amount * field))
    return np.stack(made)


def _beyond(basis: FloatArray, field: FloatArray, skin: FloatArray) -> FloatArray:
    """(V, 3) residual of a field on the ``skin`` (V,) after its least-squares fit by a ``basis`` (V, 3, E)."""
    directions, left = basis[skin].reshape(-1, basis.shape[2]), field.copy()
    wanted = field[skin].ravel()
    found, *_ = np.linalg.lstsq(directions, wanted, rcond=None)
    left[skin] = (wanted - directions @ found).reshape(-1, 3)
    return left


def displacement(correctives: FloatArray, level: float, activations: Activations) -> FloatArray:
    """(V, 3) displacement by all correctives (C, V, 3), on the grid of lengths."""
    driven = level * strengths(activations)
    return on_grid((driven[:, None, None] * correctives).sum(axis=0), LENGTH_BITS)
