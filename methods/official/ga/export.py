"""Export of captures and lists of frames for GaussianAvatars' loader."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ....bench.contracts import ByteArray, Camera, Clip, FrameKey, HeadPose, Progress
from ....bench.errors import InputError
from ....bench.io.files import write_json
from ....bench.io.images import write_png
from ....datasets.ga import layout
from ....datasets.ga.writer import CANONICAL_JAW, camera_record, save_npz, transforms_document
from ..workplace import Listed, Workplace, read_sized
from .head_files import OfficialTracking
from .windows import Window, around, cameras_of, inside

TRAIN, VALIDATION, TEST = layout.SPLIT_FILES.values()
MARK_LEVELS, MARK_STEP = 16, 16
"""A mark is a colour with 16 levels per channel, 16 apart, so that rounding cannot confuse them."""


def write_training(
    clip: Clip, tracking: OfficialTracking, work: Workplace, progress: Progress
) -> dict[str, FrameKey]:
    """Write only the training frames as a capture: timesteps numbered from 0, other splits empty.

    Returns the key of every image by its path. The loader opens the JSONs of all three splits, takes the static offset
    from timestep 0, and chooses its dynamic reader by the canonical parameters, whose content it never reads.
    """
    timesteps = sorted({key.timestep for key in clip.splits["train"]})
    number = {timestep: index for index, timestep in enumerate(timesteps)}
    windows = {name: inside(camera) for name, camera in cameras_of(clip, "train").items()}
    names = list(windows)
    keys = sorted(clip.splits["train"], key=lambda key: (key.timestep, key.camera))
    records, images = [], {}
    for done, key in enumerate(keys, 1):
        index = names.index(key.camera)
        image = f"images/{layout.frame_name(number[key.timestep], index)}.png"
        write_png(work.input / image, windows[key.camera].cut(clip.image(key)))
        records.append(_record(windows[key.camera], index, number[key.timestep], image))
        images[f"input/{image}"] = key
        progress(done, len(keys), "exporting")
    for timestep, index in number.items():
        tracking.write(work.input / _parameters(index), clip.poses[timestep])
    _write_splits(work.input, {TRAIN: records}, windows[names[-1]].camera)
    _write_canonical(work.input, tracking, clip.poses[timesteps[0]])
    return images


def write_list(frames: Sequence[Listed], tracking: OfficialTracking, work: Workplace) -> list[HeadPose]:
    """Write frames to render as the test split of a capture; return the pose of each of its timesteps.

    The image of each is a mark, a single colour that encodes its number. The loader reads it as ground truth and the
    renderer writes it beside the render, so that `check_mark` can identify the frame of a file. The training split,
    from which the loader takes the scene's size, is the first frame.
    """
    poses: list[HeadPose] = []
    number: dict[int, int] = {}
    records = []
    for frame in frames:
        if id(frame.pose) not in number:
            number[id(frame.pose)] = len(poses)
            tracking.write(work.input / _parameters(len(poses)), frame.pose)
            poses.append(frame.pose)
        window, image = around(frame.camera), f"images/{frame.number:05d}.png"
        size = window.camera.height, window.camera.width, 3
        write_png(work.input / image, np.full(size, mark(frame.number), np.uint8))
        records.append(_record(window, frame.number, number[id(frame.pose)], image))
    _write_splits(work.input, {TRAIN: records[:1], TEST: records}, frames[-1].camera)
    _write_canonical(work.input, tracking, poses[0])
    return poses


def mark(number: int) -> ByteArray:
    """(3,) colour that encodes a frame's number modulo 4,096."""
    digits = [number // MARK_LEVELS**place % MARK_LEVELS for place in range(3)]
    return np.array([MARK_STEP * digit + MARK_STEP // 2 for digit in digits], np.uint8)


def check_mark(image: ByteArray, path: Path, number: int) -> None:
    """Raise `InputError` if pixels of a file are not the frame's mark, which means that another frame was rendered."""
    pixels = image.reshape(-1, 3).astype(int)
    off = int(np.abs(pixels - mark(number).astype(int)).max())
    if off >= MARK_STEP // 2:
        raise InputError(path, "", f"the mark of frame {number}", "that of another: the order has changed")


def read_window(frame: Listed, path: Path) -> ByteArray:
    """A render at the size of its camera. Raises `InputError` for a render of another size than its window."""
    window = around(frame.camera)
    return window.uncut(read_sized(path, frame, window.camera.width, window.camera.height), frame.camera)


def _parameters(timestep: int) -> str:
    return f"flame_param/{layout.parameter_name(timestep)}"


def _record(window: Window, index: int, timestep: int, image: str) -> dict[str, Any]:
    return {
        "timestep_index": timestep,
        **camera_record(window.camera, index, "bottom"),
        "file_path": image,
        "flame_param_path": _parameters(timestep),
    }


def _write_splits(folder: Path, frames: Mapping[str, Sequence[Mapping[str, Any]]], camera: Camera) -> None:
    shared = layout.intrinsics_to_json(camera, "bottom")
    for file in (TRAIN, VALIDATION, TEST):
        write_json(folder / file, transforms_document(frames.get(file, ()), shared))


def _write_canonical(folder: Path, tracking: OfficialTracking, pose: HeadPose) -> None:
    values = tracking.parameters(pose)
    zeros = {k: v if k in ("shape", "static_offset") else np.zeros_like(v) for k, v in values.items()}
    save_npz(folder / layout.CANONICAL_FILE, {**zeros, "jaw_pose": np.array([CANONICAL_JAW])})
