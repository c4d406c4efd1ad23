"""Supported trackers; add a new tracker as an entry of this table.

Metrical Tracker's files, as its own program, FlashAvatar and INSTA's script read them. Root and neck rest; the head's
motion is in the camera. ``opencv`` has world-to-camera with OpenCV's axes and K in pixels of the tracked image, both
made by PyTorch3D, whose image starts at the corner of the first pixel. Rotations are the first two rows of matrices.
The order of ``img_size`` is height, width. ``camera`` (the same in PyTorch3D's form), texture ``tex`` and light ``sh``
are not read.

Pixel3DMM's files. FLAME is posed with its root at rest, then moved by ``R`` and ``t`` about the origin (not about the
root joint), then seen by a camera with OpenGL's axes, ``R_base_0`` and ``t_base_0``. The focal length ``fl`` is in
widths of the square tracked image, and the principal point is (1 + pp) (size / 2 + 1/2). This is how the program draws
the mesh. Its landmarks are projected with an offset of one pixel of the tracked image (256 pixels by default) in x, so
a residual of that size is its own. Rotations are the first two rows of matrices. In its masks, labels of parts are 1 to
18, background is 0, and what lies outside the parsed box is 20. ``joint_transforms`` follow from the other parameters
and are not read.

Formats read:

- Metrical Tracker's `checkpoint/*.frame`. Written by Zielon/metrical-tracker@c2a51724 (`tracker.py`). Not checked on a file of the program.
- Pixel3DMM's `checkpoint/*.frame`. Written by SimonGiebenhain/pixel3dmm@98b5d79f (`src/pixel3dmm/tracking/tracker.py`).
  Checked on tobias-kirschstein/flexavatar@c1a31a74
  `data/pixel3dmm_processing/tracking/itw/einstein/tracking_nV1_noPho_uv2000.0_n1000.0/checkpoint/00000.frame` (rotations
  equal its matrices `R_rotation_matrix` and `joint_transforms`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, Member
from ..ga.layout import OPENGL_FROM_OPENCV
from ..ga.transforms import read_rigid
from ..monocular.clip import rotations_of_6d
from .frames import FOLDER, SUFFIX, Convert, Layout, TrackedFrame, frame_files, image_size, read_members

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

METRICAL_MEMBERS = {
    **FLAME_MEMBERS,
    "opencv.R": Member("f", (1, 3, 3), MAX_MAGNITUDE),
    "opencv.t": Member("f", (1, 3), MAX_MAGNITUDE),
    "opencv.K": Member("f", (1, 3, 3), MAX_PIXELS),
}


def metrical_frame(path: Path, number: int, arrays: Mapping[str, np.ndarray]) -> TrackedFrame:
    """A timestep of the arrays in `METRICAL_MEMBERS`."""
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


MARK = "joint_transforms"
"""An array that only these files have."""

PIXEL3DMM_MEMBERS = {
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
    """A timestep of the arrays in `PIXEL3DMM_MEMBERS`."""
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


@dataclass(frozen=True)
class TrackerFormat:
    """A tracker's files."""

    name: str
    """As in ``--format``."""
    summary: str
    """One line for help and messages."""
    mark: str
    """Name of an array that only files of this tracker have."""
    members: Mapping[str, Member]
    """Arrays of a file that are read."""
    convert: Convert
    """Makes a timestep of them."""
    layout: Layout
    """Locations of images and masks."""


FORMATS = {
    one.name: one
    for one in (
        TrackerFormat(
            name="metrical",
            summary="Metrical Tracker's checkpoint/*.frame, also in the layout of FlashAvatar",
            mark="opencv.K",
            members=METRICAL_MEMBERS,
            convert=metrical_frame,
            layout=Layout(images={"imgs": 1, "input": 0, "images": None}, masks=("alpha", "mask")),
        ),
        TrackerFormat(
            name="pixel3dmm",
            summary="Pixel3DMM's checkpoint/*.frame",
            mark=MARK,
            members=PIXEL3DMM_MEMBERS,
            convert=pixel3dmm_frame,
            layout=Layout(images={"cropped": 0}, labels="seg_og", subject=(1, 18), resized=True),
        ),
    )
}


def recognise(root: Path, name: str = "") -> TrackerFormat:
    """The format ``name``, or the one of the files under ``root``."""
    if name and name not in FORMATS:
        raise InputError("command line", "--format", ", ".join(FORMATS), repr(name))
    known = "; ".join(one.summary for one in FORMATS.values())
    first = next(iter(frame_files(root).values()), None)
    if first is None:
        expected = f"the output of a tracker: {known}"
        found = f"no {FOLDER}/*{SUFFIX}" if root.is_dir() else "no such folder"
        remedy = "Exports of VHAP need no import: `headbench lint` and `headbench run` read them."
        raise InputError(root, "", expected, found, remedy)
    if name:
        return FORMATS[name]
    names = read_members(first)
    fitting = [one for one in FORMATS.values() if one.mark in names]
    if len(fitting) != 1:
        found = f"a file with {', '.join(names)}"
        raise InputError(first, "", f"arrays of one of: {known}", found, "Name the format with --format.")
    return fitting[0]
