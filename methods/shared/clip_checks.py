"""What every method asks of a clip before it starts."""

from __future__ import annotations

from ...bench.contracts import Clip
from ...bench.errors import InputError


def check_training_split(clip: Clip) -> None:
    """Raise `InputError` unless the clip has training frames, all with a pose of its head model and a camera."""
    keys = clip.splits.get("train", ())
    if not keys:
        raise InputError(f"clip of {clip.subject}", "splits[train]", "at least one frame", "none")
    for key in keys:
        if key.camera not in clip.cameras:
            raise InputError(f"clip of {clip.subject}", str(key), "a known camera", repr(key.camera))
        pose = clip.poses.get(key.timestep)
        if pose is None:
            raise InputError(f"clip of {clip.subject}", str(key), "a tracked pose", "none")
        if pose.head_model != clip.head.version:
            raise InputError(
                f"clip of {clip.subject}",
                f"poses[{key.timestep}].head_model",
                repr(clip.head.version),
                repr(pose.head_model),
            )
