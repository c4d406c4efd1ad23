"""Names of the arrays of FLAME coefficients in the outputs of trackers."""

from __future__ import annotations

from collections.abc import Mapping

NAMES: Mapping[str, tuple[str, ...]] = {
    "expression": ("expression", "expression_params", "exp", "expcode", "expr"),
    "jaw": ("jaw", "jaw_pose", "jaw_params", "jawpose"),
    "rotation": ("rotation", "pose_params", "torso_pose", "global_pose", "globalpose"),
    "neck": ("neck", "neck_pose"),
    "eyes": ("eyes", "eyes_pose", "eye_pose"),
    "left_eye": ("eye_l_pose",),
    "right_eye": ("eye_r_pose",),
    "eyelids": ("eyelids", "eyelid_params"),
    "translation": ("translation",),
    "pose": ("pose", "posecode"),
}
"""Names of the arrays by part; ``pose`` is rotation, then jaw, of DECA and EMOCA. The first name that is found counts."""

IDENTITY = (
    "shape",
    "shapecode",
    "shape_params",
    "shape_from_facenet",
    "static_offset",
    "dynamic_offset",
    "betas",
)
"""Names of arrays of the subject, of any length."""
