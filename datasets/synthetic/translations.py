"""How each known head model plays the semantic controls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...bench.contracts import HeadAsset
from ...bench.errors import InputError
from ..head.procedural.expressions import SEMANTIC_NAMES
from ..head.procedural.model import semantic_to_coefficients
from .controls import EXPRESSION_CONTROLS, Translation

# ICT-FaceKit's shapes carry ARKit's names with _L and _R.
_ICT_PAIRED = {
    "brow_down": "browDown",
    "brow_outer_up": "browOuterUp",
    "blink": "eyeBlink",
    "squint": "eyeSquint",
    "eye_wide": "eyeWide",
    "cheek_raise": "cheekSquint",
    "nose_sneer": "noseSneer",
    "smile": "mouthSmile",
    "mouth_stretch": "mouthStretch",
    "upper_lip_up": "mouthUpperUp",
    "lower_lip_down": "mouthLowerDown",
}
_ICT_SINGLE = {
    "brow_inner_up": ("browInnerUp_L", "browInnerUp_R"),
    "cheek_puff": ("cheekPuff_L", "cheekPuff_R"),
    "mouth_frown": ("mouthFrown_L", "mouthFrown_R"),
    "pucker": ("mouthPucker",),
    "funnel": ("mouthFunnel",),
    "lip_press": ("mouthPress_L", "mouthPress_R"),
    "lip_roll": ("mouthRollLower", "mouthRollUpper"),
    "chin_raise": ("mouthShrugLower", "mouthShrugUpper"),
    "mouth_left": ("mouthLeft",),
    "mouth_right": ("mouthRight",),
}


def ict_targets(control: str) -> tuple[str, ...]:
    """ICT-FaceKit shapes that play an expression control."""
    if control in _ICT_SINGLE:
        return _ICT_SINGLE[control]
    name, _, side = control.rpartition("_")
    return (f"{_ICT_PAIRED[name]}_{side[0].upper()}",)


def named_translation(
    head: HeadAsset, names: Sequence[str], targets: Mapping[str, Mapping[str, float]]
) -> Translation:
    """Translation for a head whose expression directions have names.

    ``targets`` gives, for each control, the weights of named directions.
    """
    matrix = np.zeros((len(EXPRESSION_CONTROLS), head.expression_basis.shape[2]))
    for row, control in enumerate(EXPRESSION_CONTROLS):
        for name, weight in targets.get(control, {}).items():
            if name not in names:
                raise InputError(head.version, "expression names", name, f"{len(names)} others")
            matrix[row, list(names).index(name)] = weight
    return Translation(head.version, matrix, None)


def procedural_translation(head: HeadAsset) -> Translation:
    """The procedural head speaks these controls itself; its coefficients are combinations of them."""
    expression, eyelids = semantic_to_coefficients(head.version)
    rows = [SEMANTIC_NAMES.index(control) for control in EXPRESSION_CONTROLS]
    return Translation(head.version, expression[rows], None if eyelids is None else eyelids[rows])
