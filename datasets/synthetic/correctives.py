"""Corrective shapes of a subject, which the basis of the tracked head lacks.

Faces are not linear in their controls: where two act together, skin moves otherwise than by the sum of both. A corrective is a
smooth displacement of the skin where its controls act, different for each subject, and is driven by the product of two controls
or by the square of one. Pictures show it. The tracked mesh does not, even with exact tracking.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...bench.contracts import FloatArray
from ..head.arrays import HeadArrays, region
from ..rounding import LENGTH_BITS, on_grid
from .anatomy import SIDES, Anatomy, Person
from .fields import value_noise
from .performance import EXPRESSION_CONTROLS, SEQUENCES, Activations, Translation
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
"""Root mean square displacement of the face at level 1, over the phrases of all sequences. A choice within the 0.5 to 1 mm that
the error of a tracker has on the face."""
_PERIOD = 0.025
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
    fields = []
    for number, pair in enumerate(DRIVERS):
        rows = [EXPRESSION_CONTROLS.index(name) for name in pair if name in EXPRESSION_CONTROLS]
        coefficients = translation.expression[rows].sum(axis=0)
        moved = np.linalg.norm(np.asarray(head.expression_basis, np.float64) @ coefficients, axis=1)
        where = neutral / (_PERIOD * anatomy.scale)
        noise = [value_noise(where + 31.7 * axis, person.seed + 120 + number) for axis in range(3)]
        reach = np.where(skin, moved / moved[skin].max(), 0.0)
        fields.append(reach[:, None] * np.stack(noise, axis=1))
    face = np.intersect1d(region(head, "face"), np.flatnonzero(skin))
    spread = _spread(np.stack(fields)[:, face], [*SEQUENCES.values()])
    amplitude = on_grid(1e-3 * FACE_MM / spread, LENGTH_BITS)
    return np.stack([without_joints(head, amplitude * each) for each in fields])


def _spread(fields: FloatArray, sequences: Sequence[Sequence[Activations]]) -> float:
    """Root mean square displacement over the phrases by ``fields`` (C, n, 3)."""
    squares = []
    for phrase in (phrase for phrases in sequences for phrase in phrases):
        driven = strengths({name: phrase.get(name, 0.0) for pair in DRIVERS for name in pair})
        squares.append((np.tensordot(driven, fields, 1) ** 2).sum(axis=1).mean())
    return float(np.sqrt(np.mean(squares)))


def displacement(correctives: FloatArray, level: float, activations: Activations) -> FloatArray:
    """(V, 3) displacement by all correctives (C, V, 3), on the grid of lengths."""
    driven = level * strengths(activations)
    return on_grid((driven[:, None, None] * correctives).sum(axis=0), LENGTH_BITS)
