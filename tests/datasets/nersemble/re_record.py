"""Turn a capture, a synthetic one as a rule, back into the raw recording and tracking it could have come from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import ByteArray, Camera, FloatArray, FrameKey, HeadPose
from headbench.datasets.clip import CaptureClip
from headbench.datasets.ga.validate import require_full_grid
from headbench.datasets.ga.writer import pose_to_parameters
from headbench.datasets.nersemble.recording import read_calibration
from headbench.tests.benchmarks.raw_recordings import RecordingWriter, Release, write_tracked


def re_record(
    clip: CaptureClip,
    root: Path,
    *,
    tracking: Path | None = None,
    release: Release = "v2",
    masks: bool = True,
    source: str | Path = "",
) -> list[str]:
    """Write a clip's frames, cameras and parameters as a raw recording under ``root``; return its sequences.

    The recording shows the subject before a grey wall (`studio`), where the clip has masks. Frames become images
    with masks, as VHAP's preprocessing leaves them, or without ``masks`` videos of three frames per timestep,
    of which a reader keeps the first. Parameters go under ``tracking``, in the world that VHAP turns the
    calibration into. Excluded frames are written like the others.

    Raises
    ------
    InputError
        Where a camera has no frame at some timestep, before anything is written; ``source``, the capture the
        clip was read from, is named.
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
    """The frame with the clip's background exchanged for the wall, exactly, by its mask."""
    image, mask = clip.image(key), clip.mask(key)
    if mask is None:
        return image
    behind = 1 - mask[..., None].astype(np.float32) / 255
    exchanged = image + behind * (
        studio(clip.cameras[key.camera]) - 255 * np.asarray(clip.background, np.float32)
    )
    return np.clip(np.rint(exchanged), 0, 255).astype(np.uint8)


def _turned_pose(clip: CaptureClip, pose: HeadPose, turn: FloatArray) -> HeadPose:
    """The pose in a world turned about its origin; the head itself turns about its root joint."""
    head = clip.head
    shaped = head.template + head.shape_basis @ clip.shape + head.expression_basis @ pose.expression
    root = head.joint_regressor[0] @ (shaped + clip.static_offset)
    rotation = Rotation.from_matrix(turn) * Rotation.from_rotvec(np.asarray(pose.rotation, np.float64))
    translation = turn @ (root + pose.translation) - root
    return replace(pose, rotation=rotation.as_rotvec(), translation=translation)
