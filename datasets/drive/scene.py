"""The scene of a driven avatar: head model, identity, camera, and rest position of the head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...bench.contracts import FloatArray, FrameKey, HeadPose, Progress
from ...bench.engine.stored import HEAD_FILE, SUBJECT_FILE, StoredAvatar
from ...bench.errors import InputError
from ...bench.experiments.extremes import training_poses
from ...bench.experiments.reenactment import AT_ORIGIN, RigidMean, retarget, view_camera
from ...bench.io.arrays import MAX_MAGNITUDE, Member, read_arrays
from ..clip import CaptureClip, FrameFiles, without_images
from ..head.arrays import HeadArrays, read_head
from ..head.subject import PosedSubject
from ..mesh_pictures import portrait_camera
from .settings import DriveSettings

SEQUENCE = "drive"
"""Name of the driven sequence in captures."""


@dataclass(frozen=True, eq=False)
class AvatarScene:
    """An avatar's subject before a camera.

    Attributes
    ----------
    clip : CaptureClip
        Clip of the subject with one camera; its poses are replaced.
    rest : RigidMean
        Head pose at rest.
    """

    clip: CaptureClip
    rest: RigidMean

    @property
    def head(self) -> HeadArrays:
        """Head model of the driven poses."""
        return self.clip.head

    def placed(self, poses: Sequence[HeadPose]) -> list[HeadPose]:
        """Poses around the origin, moved to the head's rest position."""
        return [retarget(pose, AT_ORIGIN, self.rest, self.clip.subject) for pose in poses]

    def driven(self, poses: Mapping[int, HeadPose], sequences: Mapping[int, str]) -> CaptureClip:
        """The clip with other poses, all of them to be rendered; ``sequences`` names that of each timestep."""
        (camera,) = self.clip.cameras
        keys = [FrameKey(self.clip.subject, sequences[t], t, camera) for t in sorted(poses)]
        numbered = {t: replace(pose, timestep=t) for t, pose in poses.items()}
        return self.clip.derive(
            "drive",
            {"frames": len(keys)},
            poses=numbered,
            splits={"train": (), "novel_view": (), "self_reenactment": tuple(keys)},
            files=dict.fromkeys(keys, FrameFiles(None, None)),
        )


def make_scene(settings: DriveSettings, stored: StoredAvatar, progress: Progress) -> AvatarScene:
    """The scene of the settings: in the capture that is named, else in front of the avatar's own head.

    Raises `InputError` for an avatar that has no head model file and no capture, and for a capture of another subject.
    """
    if settings.capture:
        clip = settings.open(settings.capture, progress)
        stored.check_subject(clip)
        camera = view_camera(clip, settings.camera or None)
        seen = replace(clip, cameras={camera.id: camera}, excluded={})
        return AvatarScene(seen, RigidMean.of(training_poses(clip)))
    path = stored.folder / HEAD_FILE
    if not path.is_file():
        remedy = "Name the capture that the avatar was trained on: --capture."
        raise InputError(path, "", "the head model beside the avatar", "no such file", remedy)
    head = read_head(path)
    shape, offset = _identity(stored, head)
    neutral = PosedSubject(head, shape, offset).neutral
    camera = portrait_camera(neutral, settings.size, settings.size)
    fields = without_images(head, {}) | {"static_offset": offset, "cameras": {camera.id: camera}}
    subject = str(stored.record["subject"])
    return AvatarScene(CaptureClip(subject=subject, shape=shape, splits={}, files={}, **fields), AT_ORIGIN)


def _identity(stored: StoredAvatar, head: HeadArrays) -> tuple[FloatArray, FloatArray]:
    """(S,) shape and (V, 3) static offset of an avatar; without a file of them, the recorded shape and no offset."""
    path, sizes = stored.folder / SUBJECT_FILE, {"S": head.shape_basis.shape[2], "V": len(head.template)}
    if path.is_file():
        members = {
            "shape": Member("f", ("S",), MAX_MAGNITUDE),
            "static_offset": Member("f", ("V", 3), MAX_MAGNITUDE),
        }
        arrays = read_arrays(path, members, sizes)
        return arrays["shape"], arrays["static_offset"]
    shape = np.asarray(stored.record["shape"], np.float64)
    if shape.shape != (sizes["S"],):
        expected = f"{sizes['S']} coefficients, as its head model has"
        raise InputError(stored.folder, "shape", expected, str(shape.size), "Name its capture: --capture.")
    return shape, np.zeros(head.template.shape)
