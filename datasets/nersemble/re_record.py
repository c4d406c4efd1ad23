"""Convert a capture, usually a synthetic one, to a corresponding raw recording and tracking.

Names and keys are those of the real files. Participants get numbers from 900 up and a marker file, to distinguish them
from recorded people.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.contracts import ByteArray, Camera, FloatArray, FrameKey, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import write_json, write_text
from ...bench.io.video import write_video
from ..clip import CaptureClip
from ..ga.validate import require_full_grid
from ..ga.writer import pose_to_parameters, save_npz
from ..head.rotations import rotation_of
from ..images import write_image
from .names import BACKGROUND, FPS, FULL_SIZE, is_subject
from .recording import CAMERA_FILE, SEQUENCES_FILE, read_calibration


def re_record(
    clip: CaptureClip,
    root: Path,
    *,
    tracking: Path | None = None,
    release: Release = "v2",
    masks: bool = True,
    source: str | Path = "",
    progress: Progress = no_progress,
) -> list[str]:
    """Write a clip's frames, cameras and parameters as a raw recording under ``root``; return its sequences.

    The recording shows the subject in front of a grey wall (`studio`) if the clip has masks. Frames become images
    with masks, as written by VHAP's preprocessing, or without ``masks`` videos of three frames per timestep,
    of which a reader keeps the first. Parameters are written under ``tracking``, in the aligned world of VHAP.
    Excluded frames are written like the others.

    Raises
    ------
    InputError
        A camera lacks a frame at some timestep, which is checked before writing; the message names
        ``source``, the capture that the clip was read from.
    """
    require_full_grid(clip, source)
    writer = RecordingWriter(root, clip.subject, [*clip.cameras.values()], release)
    writer.write_calibration()
    for one in clip.cameras.values():
        writer.write_background(one.id, studio(one))
    # From the recording's world to the aligned one.
    first = next(iter(clip.cameras.values()))
    aligned = read_calibration(writer.calibration_file).aligned().world_to_camera[first.id]
    turn = aligned[:3, :3].T @ first.world_to_camera[:3, :3]
    by_sequence: dict[str, list[FrameKey]] = {}
    for key in sorted(clip.files):
        by_sequence.setdefault(key.sequence, []).append(key)
    done = 0
    for sequence, keys in by_sequence.items():
        timesteps = sorted({key.timestep for key in keys})
        for camera in clip.cameras:
            own = [FrameKey(clip.subject, sequence, timestep, camera) for timestep in timesteps]
            if masks or release == "paper2023":
                for number, key in enumerate(own):
                    # The 2023 frame folders count at 73 frames per second.
                    step = 3 if release == "paper2023" else 1
                    writer.write_frame(
                        sequence, camera, step * number, _before_wall(clip, key), clip.mask(key)
                    )
            else:
                writer.write_video(
                    sequence, camera, (_before_wall(clip, key) for key in own for _ in range(3))
                )
            done += len(own)
            progress(done, len(clip.files), sequence)
        if tracking is not None:
            poses = [_turned_pose(clip, clip.poses[timestep], turn) for timestep in timesteps]
            folder = tracking / f"{clip.subject}_{sequence}" / "2000-01-01_00-00-00"
            rows = [pose_to_parameters(pose) for pose in poses]
            arrays = {key: np.concatenate([row[key] for row in rows]) for key in rows[0]}
            arrays |= {"shape": clip.shape, "static_offset": clip.static_offset[None]}
            write_tracked(folder / "tracked_flame_params_30.npz", arrays, range(len(poses)))
    writer.write_metadata([*by_sequence])
    return [*by_sequence]


def studio(camera: Camera) -> ByteArray:
    """(H, W, 3) the empty set: a grey wall, brighter towards the top."""
    brightness = np.linspace(168, 120, camera.height)[:, None, None]
    return np.broadcast_to(brightness, (camera.height, camera.width, 3)).round().astype(np.uint8)


def _before_wall(clip: CaptureClip, key: FrameKey) -> ByteArray:
    """The frame with the clip's background exactly replaced by the wall, using its mask."""
    image, mask = clip.image(key), clip.mask(key)
    if mask is None:
        return image
    behind = 1 - mask[..., None].astype(np.float32) / 255
    exchanged = image + behind * (
        studio(clip.cameras[key.camera]) - 255 * np.asarray(clip.background, np.float32)
    )
    return np.clip(np.rint(exchanged), 0, 255).astype(np.uint8)


def _turned_pose(clip: CaptureClip, pose: HeadPose, turn: FloatArray) -> HeadPose:
    """The pose in a world rotated about its origin; the head rotates about its root joint."""
    head = clip.head
    shaped = head.template + head.shape_basis @ clip.shape + head.expression_basis @ pose.expression
    root = head.joint_regressor[0] @ (shaped + clip.static_offset)
    rotation = Rotation.from_matrix(turn) * rotation_of(pose.rotation)
    translation = turn @ (root + pose.translation) - root
    return replace(pose, rotation=rotation.as_rotvec(), translation=translation)


Release = Literal["v2", "v1", "paper2023"]

SYNTHETIC_IDS = 900
"""Participants with this and higher numbers are synthetic."""

MARKER_FILE = "SYNTHETIC.txt"
_MARKER = "Synthetic recordings in NeRSemble's layout, written by headbench. No person was recorded.\n"

_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 97)


class RecordingWriter:
    """Writes one synthetic participant under ``root``.

    Parameters
    ----------
    subject : str
        Three-digit id from 900.
    cameras : Sequence[Camera]
        Cameras in the order of the rig, with the sizes of the recorded images.
    release : Release
        Layout: "v2", "v1" (parts merged) or "paper2023" (a folder of PNGs per frame).
    """

    def __init__(self, root: Path, subject: str, cameras: Sequence[Camera], release: Release = "v2"):
        if not is_subject(subject) or int(subject) < SYNTHETIC_IDS:
            raise InputError("recording", "subject", f"an id from {SYNTHETIC_IDS}", repr(subject))
        self.root, self.subject, self.cameras, self.release = Path(root), subject, cameras, release
        self._participant = self.root / subject

    @property
    def calibration_file(self) -> Path:
        """``camera_params.json``."""
        folder = {
            "v2": self._participant / "calibration",
            "v1": self.root / "camera_params" / self.subject,
            "paper2023": self._participant,
        }[self.release]
        return folder / CAMERA_FILE

    def sequence_folder(self, sequence: str) -> Path:
        """Folder of a sequence."""
        parent = self._participant if self.release == "v1" else self._participant / "sequences"
        return parent / sequence

    def write_calibration(self) -> None:
        """Write ``camera_params.json``: one intrinsic matrix if all cameras share it, else one per camera.

        ``height`` and ``width`` are stated if they differ from those of the real recordings.
        """
        write_text(self.root / MARKER_FILE, _MARKER)
        first = self.cameras[0]
        sizes = {(camera.width, camera.height) for camera in self.cameras}
        if len(sizes) > 1:
            raise InputError("recording", "cameras", "cameras of one image size", f"{sorted(sizes)}")
        shared = all(np.array_equal(camera.K, first.K) for camera in self.cameras)
        intrinsics = first.K if shared else {camera.id: camera.K for camera in self.cameras}
        value = {
            "world_2_cam": {camera.id: camera.world_to_camera for camera in self.cameras},
            "intrinsics": intrinsics,
        }
        size = sizes.pop()
        stated = {} if size == FULL_SIZE else {"height": size[1], "width": size[0]}
        write_json(self.calibration_file, {**value, **stated})

    def write_background(self, serial: str, rgb: ByteArray) -> None:
        """Write the still of the empty set."""
        folder = self.sequence_folder(BACKGROUND)
        write_image(folder / f"image_{serial}.jpg", rgb, *_JPEG)

    def write_video(self, sequence: str, serial: str, frames: Iterable[ByteArray]) -> str:
        """Write a camera's video of RGB frames; return the codec, see `video_codec`."""
        folder = self.sequence_folder(sequence)
        folder = folder / "images" if self.release == "v2" else folder
        return write_video(folder / f"cam_{serial}.mp4", frames, FPS)

    def write_frame(
        self, sequence: str, serial: str, number: int, rgb: ByteArray, mask: ByteArray | None = None
    ) -> None:
        """Write a frame as an image file, as VHAP's preprocessing does, or the 2023 release where it is that."""
        folder = self.sequence_folder(sequence)
        if self.release == "paper2023":
            frame, name, kinds = (
                folder / f"frame_{number:05d}",
                f"cam_{serial}.png",
                ("images-2x", "alpha_map"),
            )
        else:
            frame, name, kinds = folder, f"cam_{serial}_{number:06d}.jpg", ("images", "alpha_maps")
        options = _JPEG if name.endswith(".jpg") else ()
        for kind, pixels in zip(kinds, (rgb, mask)):
            if pixels is not None:
                write_image(frame / kind / name, pixels, *options)

    def write_metadata(self, sequences: Sequence[str]) -> None:
        """Write ``metadata_sequences.csv`` with this participant's sequences."""
        header = ["ID", "wears_glasses", *sequences]
        row = [str(int(self.subject)), "", *("x" for _ in sequences)]
        write_text(self.root / SEQUENCES_FILE, "".join(",".join(line) + "\n" for line in (header, row)))


def write_tracked(path: Path, arrays: Mapping[str, FloatArray], numbers: Sequence[int]) -> None:
    """Write tracked parameters as VHAP does, float32: ``rotation``, ``translation``, ``neck_pose``, ``jaw_pose``
    (T, 3), ``eyes_pose`` (T, 6), ``expr`` (T, E), ``shape`` (S,), ``static_offset`` (1, V, 3)."""
    values = {key: np.asarray(value, dtype=np.float32) for key, value in arrays.items()}
    values["timestep_id"] = np.array([f"{number:06d}" for number in numbers])
    values["n_processed_frames"] = np.array(len(numbers))
    save_npz(path, values)
