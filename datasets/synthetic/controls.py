"""Semantic controls of a face, and their translation into a head model's own coefficients.

A performance is written in these controls (after the action units of Ekman and Friesen's FACS, named as
animators do); each head model with a translation below can play it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...bench.contracts import FloatArray, HeadPose

Activations = Mapping[str, float]

_PAIRED = (
    *("brow_down", "brow_outer_up", "blink", "squint", "eye_wide", "cheek_raise", "nose_sneer", "smile"),
    *("mouth_stretch", "upper_lip_up", "lower_lip_down"),
)
EXPRESSION_CONTROLS = (
    "brow_inner_up",
    *(f"{name}_{side}" for name in _PAIRED for side in ("left", "right")),
    *("cheek_puff", "mouth_frown", "pucker", "funnel", "lip_press", "lip_roll", "chin_raise"),
    *("mouth_left", "mouth_right"),
)
"""Shapes of the skin; each is 0 at rest and 1 at its natural extreme."""

POSE_CONTROLS = (
    *("jaw_open", "jaw_side", "gaze_left", "gaze_up", "head_turn", "head_nod", "head_tilt"),
    *("neck_turn", "neck_nod", "sway_x", "sway_y", "sway_z", "tongue_out"),
)
"""Jaw and tongue in [0, 1] (sideways and gaze in [-1, 1]); head, neck in radians; sway in metres."""

CONTROLS = (*EXPRESSION_CONTROLS, *POSE_CONTROLS)

_JAW_OPEN = 0.36  # radians at jaw_open = 1
_JAW_SIDE = 0.09
_GAZE_SIDE, _GAZE_UP = 0.45, 0.32


@dataclass(frozen=True, eq=False)
class Translation:
    """From expression controls to one head model: ``expression`` (K, E) and, where it has them, eyelids (K, 2).

    Both stand on the grid of coefficients, as activations do: their products and sums are exact.
    """

    head_model: str
    expression: FloatArray
    eyelids: FloatArray | None

    def pose(self, activations: Activations, subject: str, timestep: int | None) -> HeadPose:
        """The head pose of one moment, rounded to float32 as it will be stored."""
        a = activations
        values = np.array([a[name] for name in EXPRESSION_CONTROLS])
        gaze = [-_GAZE_UP * a["gaze_up"], _GAZE_SIDE * a["gaze_left"], 0.0]
        fields = {
            "expression": values @ self.expression,
            "rotation": np.array([a["head_nod"], a["head_turn"], a["head_tilt"]]),
            "neck": np.array([a["neck_nod"], a["neck_turn"], 0.0]),
            "jaw": np.array([_JAW_OPEN * a["jaw_open"], _JAW_SIDE * a["jaw_side"], 0.0]),
            "eyes": np.array(gaze + gaze),
            "translation": np.array([a["sway_x"], a["sway_y"], a["sway_z"]]),
        }
        stored = {name: value.astype(np.float32).astype(np.float64) for name, value in fields.items()}
        eyelids = (
            None if self.eyelids is None else (values @ self.eyelids).astype(np.float32).astype(np.float64)
        )
        return HeadPose(self.head_model, **stored, eyelids=eyelids, subject=subject, timestep=timestep)
