"""Conversion of a clip to the requirements of a method, and of its renders back.

Found by the harness as the entry point of `headbench.adaptation`, see `headbench.bench.engine.adaptation`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...bench.contracts import Clip, FloatArray, FrameKey, Progress
from ...bench.engine.adaptation import Adaptation, AdaptedClip, MethodNeeds
from ...bench.errors import InputError
from ..clip import CaptureClip, as_capture
from ..ga.tracking import find_head
from ..head.arrays import HeadArrays
from ..head.procedural.model import procedural_head
from ..head.procedural.versions import VERSIONS
from ..head.refit.refit import refit
from ..head.subject import PosedSubject, camera_in_head_frame, pose_in_head_frame
from .resolution import align_clip, alignments


def clip_for_method(source: Clip, needs: MethodNeeds, heads: Mapping[str, str]) -> Adaptation:
    """Check that a clip can be converted to the requirements of a method, and return the conversion.

    The order is: tracking refitted to a head model the method accepts, images aligned to its size, views joined
    into one video.

    Parameters
    ----------
    heads : Mapping[str, str]
        Head model files by version, to refit to. The procedural head's versions need none.
    """
    clip = as_capture(source)
    target = None
    if needs.head_models and clip.head.version not in needs.head_models:
        target = _target(clip, needs.head_models, heads)
    alignments(clip.cameras, needs.resolution)
    return partial(_adapt, clip, needs, target)


def _adapt(
    clip: CaptureClip, needs: MethodNeeds, target: HeadArrays | None, folder: Path, progress: Progress
) -> AdaptedClip:
    tracked = clip if target is None else refit(clip, target, folder=folder, progress=progress).clip
    aligned = align_clip(tracked, needs.resolution)
    plans = alignments(tracked.cameras, needs.resolution)
    ground = np.asarray(clip.background, np.float32)

    def restore(key: FrameKey, render: FloatArray) -> FloatArray:
        return plans[key.camera].restore(render, ground)

    if not needs.monocular:
        return AdaptedClip(aligned, restore=restore)
    video = as_single_video(aligned)
    return AdaptedClip(video.clip, video.keys.__getitem__, restore)


def _target(clip: CaptureClip, accepted: tuple[str, ...], heads: Mapping[str, str]) -> HeadArrays:
    """The first available head model that the method accepts."""
    for version in accepted:
        if version in heads:
            head = find_head(Path(heads[version]).parent, None, heads[version])
            if head.version != version:
                raise InputError(heads[version], "version", repr(version), repr(head.version))
            return head
        if version in VERSIONS and clip.head.version in VERSIONS:
            return procedural_head(version)
    raise InputError(
        f"clip {clip.subject}",
        "head_models",
        f"tracking with {' or '.join(accepted)}, or the file of such a head model to refit to",
        f"tracking with {clip.head.version}, head models {', '.join(sorted(heads)) or 'none'}",
        f"Name the file: --set heads.{accepted[0]}=PATH.",
    )


class SingleVideo(NamedTuple):
    """A clip as one video, and the source frame of each of its frames."""

    clip: CaptureClip
    """The video. Its timesteps are frame numbers: first all training frames, then those of the other splits, then
    excluded ones. No two frames share a timestep or a camera."""
    keys: Mapping[FrameKey, FrameKey]
    """Key in the video by key in the source."""


def as_single_video(clip: CaptureClip) -> SingleVideo:
    """Concatenate the views of a clip into one video: all of the first camera, then all of the next.

    This is how the paper gave multi-view captures to GaussianBlendshapes. Training frames come first and are
    numbered without a gap; frames of other splits have later numbers; they are not part of the video, but keep pose
    and camera for rendering. The head's rigid motion moves into the cameras (see `head.subject`): every frame has its
    own camera, named after the one that recorded it, and a pose without rotation, neck and translation.
    """
    order = _order(clip)
    width = len(str(len(order) - 1))
    keys = {
        key: key._replace(timestep=number, camera=f"{key.camera}-{number:0{width}d}")
        for number, key in enumerate(order)
    }
    timesteps = sorted({key.timestep for key in order})
    poses, cameras = {}, {}
    motions = dict(zip(timesteps, PosedSubject.of(clip).motions([clip.poses[t] for t in timesteps])))
    for key, new in keys.items():
        # A separate pose, so that refinement by a method affects only this frame.
        still = pose_in_head_frame(clip.poses[key.timestep])
        poses[new.timestep] = replace(still, timestep=new.timestep)
        camera = camera_in_head_frame(clip.cameras[key.camera], motions[key.timestep])
        cameras[new.camera] = replace(camera, id=new.camera)
    video = clip.derive(
        "as_single_video",
        {"order": "camera, then timestep; training frames first", "head_frame": True},
        cameras=cameras,
        poses=poses,
        splits={
            name: tuple(sorted((keys[key] for key in part), key=lambda key: key.timestep))
            for name, part in clip.splits.items()
        },
        excluded={keys[key]: reason for key, reason in clip.excluded.items()},
        files={keys[key]: clip.files[key]._replace(recorded=clip.recorded(key)) for key in order},
    )
    return SingleVideo(video, keys)


def _order(clip: CaptureClip) -> list[FrameKey]:
    """Frames by split, camera and timestep; each once."""
    parts = [clip.splits["train"], *(part for name, part in clip.splits.items() if name != "train")]
    ordered = [key for part in parts for key in sorted(part, key=lambda key: (key.camera, key.timestep))]
    rest = sorted(set(clip.files) - set(ordered), key=lambda key: (key.camera, key.timestep))
    return [*dict.fromkeys([*ordered, *rest])]
