"""Pixel3DMM's files.

FLAME is posed with its root at rest, then moved by ``R`` and ``t`` about the origin (not about the root joint), then seen
by a camera with OpenGL's axes, ``R_base_0`` and ``t_base_0``. The focal length ``fl`` is in widths of the square tracked
image, and the principal point is (1 + pp) (size / 2 + 1/2). This is how the program draws the mesh. Its landmarks are
projected with an offset of one pixel of the tracked image (256 pixels by default) in x, so a residual of that size is its
own. Rotations are the first two rows of matrices. In its masks, labels of parts are 1 to 18, background is 0, and what lies
outside the parsed box is 20. ``joint_transforms`` follow from the other parameters and are not read.

Formats read:

- Pixel3DMM's `checkpoint/*.frame`. Written by SimonGiebenhain/pixel3dmm@98b5d79f (`src/pixel3dmm/tracking/tracker.py`).
  Checked on tobias-kirschstein/flexavatar@c1a31a74
  `data/pixel3dmm_processing/tracking/itw/einstein/tracking_nV1_noPho_uv2000.0_n1000.0/checkpoint/00000.frame` (rotations
  equal its matrices `R_rotation_matrix` and `joint_transforms`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, Member
from ..ga.layout import OPENGL_FROM_OPENCV
from ..ga.transforms import read_rigid
from .frames import TrackedFrame, image_size
from .metrical import FLAME_MEMBERS, flame_parameters, turns

MARK = "joint_transforms"
"""An array that only these files have."""

MEMBERS = {
    **FLAME_MEMBERS,
    "flame.neck": Member("f", (1, 6), MAX_MAGNITUDE),
    "flame.R": Member("f", (1, 6), MAX_MAGNITUDE),
    "flame.t": Member("f", (1, 3), MAX_MAGNITUDE),
    "camera.R_base_0": Member("f", (1, 3, 3), MAX_MAGNITUDE),
    "camera.t_base_0": Member("f", (1, 3), MAX_MAGNITUDE),
    "camera.fl": Member("f", (1, 1), MAX_MAGNITUDE),
    "camera.pp": Member("f", (1, 2), MAX_MAGNITUDE),
}


def pixel3dmm_frame(path: Path, number: int, arrays: Mapping[str, np.ndarray]) -> TrackedFrame:
    """A timestep of the arrays in `MEMBERS`.

    Raises `InputError` for rotations that are none, several cameras, and an image that is not square.
    """
    if "camera.R_base_1" in arrays:
        raise InputError(path, "camera.R_base_1", "one camera", "several")
    width, height = image_size(path, arrays)
    if width != height:
        raise InputError(path, "img_size", "a square image, as Pixel3DMM crops it", f"{width}x{height}")
    moved, seen = np.eye(4), np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(turns(path, arrays, "flame.R")).as_matrix()
    moved[:3, 3] = arrays["flame.t"][0]
    seen[:3] = np.column_stack([arrays["camera.R_base_0"][0], arrays["camera.t_base_0"][0]])
    focal = float(arrays["camera.fl"][0, 0]) * width
    x, y = (1 + arrays["camera.pp"][0].astype(np.float64)) * (width / 2 + 0.5)
    return TrackedFrame(
        file=path,
        number=number,
        width=width,
        height=height,
        K=np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]]),
        world_to_camera=OPENGL_FROM_OPENCV @ read_rigid(path, "camera.R_base_0", seen) @ moved,
        neck=turns(path, arrays, "flame.neck"),
        **flame_parameters(path, arrays),
    )
