"""Metrical Tracker's files, as its own program, FlashAvatar and INSTA's script read them.

Root and neck rest; the head's motion is in the camera. ``opencv`` has world-to-camera with OpenCV's axes and K in pixels
of the tracked image, both made by PyTorch3D, whose image starts at the corner of the first pixel. Rotations are the
first two rows of matrices. The order of ``img_size`` is height, width. ``camera`` (the same in PyTorch3D's form),
texture ``tex`` and light ``sh`` are not read.

Formats read:

- Metrical Tracker's `checkpoint/*.frame`. Written by Zielon/metrical-tracker@c2a51724 (`tracker.py`). Not checked on a file of the program.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...bench.io.arrays import MAX_MAGNITUDE, Member
from ..ga.transforms import read_rigid
from ..monocular.track import rotations_of_6d
from .frames import TrackedFrame, image_size

MAX_PIXELS = 1e6
"""Largest focal length, principal point and image size, pixels."""

FLAME_MEMBERS = {
    "flame.shape": Member("f", (1, "S"), MAX_MAGNITUDE),
    "flame.exp": Member("f", (1, "E"), MAX_MAGNITUDE),
    "flame.jaw": Member("f", (1, 6), MAX_MAGNITUDE),
    "flame.eyes": Member("f", (1, 12), MAX_MAGNITUDE),
    "flame.eyelids": Member("f", (1, 2), MAX_MAGNITUDE),
    "img_size": Member("iu", (2,), MAX_PIXELS),
}
"""Arrays that Metrical Tracker and its descendants share."""

MEMBERS = {
    **FLAME_MEMBERS,
    "opencv.R": Member("f", (1, 3, 3), MAX_MAGNITUDE),
    "opencv.t": Member("f", (1, 3), MAX_MAGNITUDE),
    "opencv.K": Member("f", (1, 3, 3), MAX_PIXELS),
}


def metrical_frame(path: Path, number: int, arrays: Mapping[str, np.ndarray]) -> TrackedFrame:
    """A timestep of the arrays in `MEMBERS`. Raises `InputError` for invalid rotations."""
    motion = np.eye(4)
    motion[:3] = np.column_stack([arrays["opencv.R"][0], arrays["opencv.t"][0]])
    width, height = image_size(path, arrays)
    return TrackedFrame(
        file=path,
        number=number,
        width=width,
        height=height,
        K=arrays["opencv.K"][0].astype(np.float64),
        world_to_camera=read_rigid(path, "opencv.R", motion),
        neck=np.zeros(3),
        **flame_parameters(path, arrays),
    )


def flame_parameters(path: Path, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Parameters in `FLAME_MEMBERS` by attribute of `TrackedFrame`, rotations as axis-angle."""
    return {
        "shape": arrays["flame.shape"][0].astype(np.float64),
        "expression": arrays["flame.exp"][0].astype(np.float64),
        "jaw": turns(path, arrays, "flame.jaw"),
        "eyes": turns(path, arrays, "flame.eyes"),
        "eyelids": arrays["flame.eyelids"][0].astype(np.float64),
    }


def turns(path: Path, arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Axis-angle of the 6D rotations in an array, one vector after the other."""
    return rotations_of_6d(path, name, arrays[name].astype(np.float64).reshape(-1, 6)).ravel()
