"""Common representation of tracked videos: frames with a camera and a pose each.

In these layouts the head is static, or nearly so, and every frame has its own camera. A clip has one camera and a
moving head: `fix_camera` converts the former to the latter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ...bench.contracts import Camera, FloatArray, HeadPose
from ...bench.errors import InputError
from ..head.arrays import HeadArrays
from ..head.model import HeadModel
from ..head.rotations import rotation_of

VIDEO = "video"
"""Name of the sequence where a layout names none."""
SAME_INTRINSICS = 1e-3
"""Maximum difference of the intrinsics of one camera, pixels."""


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One frame of a layout, in this project's units and axes.

    Attributes
    ----------
    where : tuple[Path, str]
        File and entry, for messages.
    sequence, number : str, int
        The video's name, and the frame's number in its file name.
    image, mask : Path, Path | None
        Files; the mask is the image itself if that has straight alpha.
    inside : Path | None
        A second mask; the coverage is the product of the two.
    pose : HeadPose
        Pose in the world that ``camera`` maps from; its timestep is not set yet.
    """

    where: tuple[Path, str]
    sequence: str
    number: int
    image: Path
    mask: Path | None
    camera: Camera
    pose: HeadPose
    inside: Path | None = None

    @property
    def name(self) -> tuple[str, int]:
        """Identity and sort key of a frame."""
        return self.sequence, self.number


@dataclass(frozen=True, eq=False)
class Track:
    """A tracked video, or several of one subject.

    Attributes
    ----------
    frames : Sequence[VideoFrame]
        Sorted by `VideoFrame.name`, without duplicates.
    shape : FloatArray
        (S,) identity coefficients of the head model.
    solid : tuple[float, float] | None
        Coverage range (low, high] in [0, 1] that becomes 1, all else 0, as in the layout's own loader; None keeps masks
        unchanged.
    held_out : frozenset[tuple[str, int]] | None
        Names of the frames that the layout holds out; None if it does not define a split.
    files : frozenset[Path]
        All files that were read, except images.
    notes : Mapping[str, Any]
        Properties that the layout does not define, and the choices made.
    """

    frames: Sequence[VideoFrame]
    shape: FloatArray
    held_out: frozenset[tuple[str, int]] | None
    files: frozenset[Path]
    notes: Mapping[str, Any] = field(default_factory=dict)
    solid: tuple[float, float] | None = None


def ordered(root: Path, frames: Sequence[VideoFrame]) -> list[VideoFrame]:
    """Frames by name. Raises `InputError` if there are none, or two with the same name."""
    if not frames:
        raise InputError(root, "frames", "at least one frame", "none")
    found: dict[tuple[str, int], VideoFrame] = {}
    for frame in frames:
        other = found.setdefault(frame.name, frame)
        if other is not frame:
            file, entry = frame.where
            expected = "every frame once"
            raise InputError(
                file, entry, expected, f"frame {frame.number} again, which is {other.where[1]} too"
            )
    return [found[name] for name in sorted(found)]


def frame_number(file: Path, entry: str, stem: str) -> int:
    """Number in the names of a frame's files. Raises `InputError` for a name without one."""
    if not (stem.isascii() and stem.isdecimal() and len(stem) < 10):
        raise InputError(file, entry, "files named by the frame's number, such as 00012", repr(stem)[:60])
    return int(stem)


def fix_camera(
    frames: Sequence[VideoFrame], head: HeadArrays, shape: FloatArray, subject: str
) -> tuple[Camera, dict[int, HeadPose]]:
    """The camera of the first frame, and by index the poses that give the same view in it as each frame's own camera.

    With W the camera of a frame and W0 the first, the head moves by M = W0^-1 W: its global rotation becomes R_M R, and
    since that turns about joint 0 at J (which moves with the expression) its translation R_M (J + t) + t_M - J.

    Raises `InputError` if frames differ in image size or intrinsics.
    """
    first = frames[0].camera
    for frame in frames:
        camera = frame.camera
        off = float(np.abs(camera.K - first.K).max())
        if (camera.width, camera.height) != (first.width, first.height):
            expected = f"{first.width}x{first.height} pixels, as the first image of the video"
            raise InputError(frame.image, "", expected, f"{camera.width}x{camera.height}")
        if not off <= SAME_INTRINSICS:
            file, entry = frame.where
            expected = "the intrinsics of the first frame, as one camera has"
            raise InputError(file, entry, expected, f"others, by {off:g} pixels")
    model = HeadModel(head, dtype=torch.float64)
    expressions = torch.from_numpy(np.stack([frame.pose.expression for frame in frames]))
    with torch.no_grad():
        roots = model.joints(torch.from_numpy(np.asarray(shape, np.float64)), expressions)[:, 0].numpy()
    back = np.linalg.inv(first.world_to_camera)
    poses = {}
    for index, (frame, root) in enumerate(zip(frames, roots)):
        motion = back @ frame.camera.world_to_camera if index else np.eye(4)
        turn = Rotation.from_matrix(motion[:3, :3])
        own = frame.pose
        poses[index] = HeadPose(
            head_model=own.head_model,
            expression=own.expression,
            rotation=(turn * rotation_of(own.rotation)).as_rotvec(),
            neck=own.neck,
            jaw=own.jaw,
            eyes=own.eyes,
            translation=turn.apply(root + own.translation) + motion[:3, 3] - root,
            eyelids=own.eyelids,
            subject=subject,
            timestep=index,
        )
    return first, poses


def coefficients(file: Path, entry: str, values: FloatArray, size: int) -> FloatArray:
    """Coefficients as a vector of ``size``: padded with zeros, or truncated if the remainder is zero.

    Raises `InputError` if the head model lacks a used direction.
    """
    if np.any(values[size:]):
        expected = f"at most {size} coefficients, which the head model has, or zeros behind them"
        remedy = "Give the head model the video was tracked with."
        raise InputError(file, entry, expected, f"{len(values)}", remedy)
    kept = values[:size]
    return np.pad(kept, (0, size - len(kept)))


def rotations_of_6d(file: Path, entry: str, rows: FloatArray) -> FloatArray:
    """(N, 3) axis-angle of (N, 6) rotations that are the first two rows of a matrix, made orthonormal in order.

    Raises `InputError` for two vectors of one direction.
    """
    first, second = rows[:, :3], rows[:, 3:]
    normal = np.cross(first, second)
    if np.linalg.norm(normal, axis=1).min() < 1e-6:
        raise InputError(file, entry, "6D rotations: two vectors of different directions", "none")
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    third = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    matrices = np.stack([first, np.cross(third, first), third], axis=1)
    return Rotation.from_matrix(matrices).as_rotvec()
