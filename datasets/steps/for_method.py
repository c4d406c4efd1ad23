"""A clip in the form that a method needs: the steps that lead there, in order, and the way back.

Found by the harness as the entry point of `headbench.adaptation`, see `headbench.bench.runner.adaptation`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ...bench.contracts import Camera, Clip, FloatArray, FrameKey, HeadPose, Progress
from ...bench.errors import InputError
from ...bench.runner.adaptation import Adaptation, AdaptedClip, MethodNeeds
from ..clip import CaptureClip, FrameFiles, as_capture
from ..ga.tracking import find_head
from ..head.arrays import HeadArrays
from ..head.procedural.model import VERSIONS, procedural_head
from ..head.refit.refit import refit_clip
from ..head.subject import PosedSubject, camera_in_head_frame, pose_in_head_frame
from .resolution import align_clip, alignments


def clip_for_method(source: Clip, needs: MethodNeeds, heads: Mapping[str, str]) -> Adaptation:
    """Check that a clip can be brought into the form needed, and return what does it.

    The order is: tracking refitted to a head model the method accepts, images aligned to its size, views joined
    into one video.

    Parameters
    ----------
    heads : files of head models by version, to refit to. The procedural head's versions need none.

    Raises
    ------
    InputError
        Where the method accepts none of the head models at hand, a file holds another version than it is said to,
        or images are too small for the resolution rule.
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
    tracked = clip if target is None else refit_clip(clip, target, folder=folder, progress=progress)
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
    """The first head model the method accepts that is at hand."""
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


@dataclass(frozen=True, eq=False)
class SingleVideo:
    """A clip as one video, and which frame of the source each of its frames is.

    Attributes
    ----------
    clip : the video. Its timesteps are frame numbers: first all training frames, then those of the other splits,
        then those left out. No two frames share a timestep or, with the head's motion in the cameras, a camera.
    keys : key in the video by key in the source.
    """

    clip: CaptureClip
    keys: Mapping[FrameKey, FrameKey]

    @property
    def sources(self) -> dict[FrameKey, FrameKey]:
        """Key in the source by key in the video."""
        return {video: source for source, video in self.keys.items()}


def as_single_video(clip: CaptureClip, *, head_frame: bool = True) -> SingleVideo:
    """Concatenate the views of a clip into one video: all of the first camera, then all of the next.

    This is how the paper gave multi-view captures to GaussianBlendshapes. Training frames come first and are
    numbered without a gap; frames of other splits have later numbers and are in no way part of the video, they keep
    their pose and camera so that they can be rendered.

    Parameters
    ----------
    head_frame : move the head's rigid motion into the cameras (see `head_frame`): then every frame has a camera of
        its own, named after the one that recorded it, and poses without rotation, neck and translation. Otherwise
        cameras and poses stay and only timesteps are renumbered.
    """
    order = _order(clip)
    width = len(str(len(order) - 1))
    keys = {
        key: key._replace(
            timestep=number, camera=f"{key.camera}-{number:0{width}d}" if head_frame else key.camera
        )
        for number, key in enumerate(order)
    }
    poses = {keys[key].timestep: _numbered(clip.poses[key.timestep], keys[key]) for key in order}
    cameras: dict[str, Camera] = dict(clip.cameras)
    if head_frame:
        timesteps = sorted({key.timestep for key in order})
        motions = PosedSubject(clip.head, clip.shape, clip.static_offset).motions(
            [clip.poses[timestep] for timestep in timesteps]
        )
        motion = dict(zip(timesteps, motions))
        poses = {timestep: pose_in_head_frame(pose) for timestep, pose in poses.items()}
        cameras = {}
        for key in order:
            camera = camera_in_head_frame(clip.cameras[key.camera], motion[key.timestep])
            cameras[keys[key].camera] = replace(camera, id=keys[key].camera)
    video = clip.derive(
        "as_single_video",
        {"order": "camera, then timestep; training frames first", "head_frame": head_frame},
        cameras=cameras,
        poses=poses,
        splits={
            name: tuple(sorted((keys[key] for key in part), key=lambda key: key.timestep))
            for name, part in clip.splits.items()
        },
        excluded={keys[key]: reason for key, reason in clip.excluded.items()},
        files={keys[key]: _recorded(clip, key) for key in order},
    )
    return SingleVideo(video, keys)


def _order(clip: CaptureClip) -> list[FrameKey]:
    """Frames by split, camera and timestep; each once."""
    parts = [clip.splits["train"], *(part for name, part in clip.splits.items() if name != "train")]
    ordered = [key for part in parts for key in sorted(part, key=lambda key: (key.camera, key.timestep))]
    rest = sorted(set(clip.files) - set(ordered), key=lambda key: (key.camera, key.timestep))
    return [*dict.fromkeys([*ordered, *rest])]


def _numbered(pose: HeadPose, key: FrameKey) -> HeadPose:
    """The pose as one of the video's own, so that what a method refines belongs to this frame alone."""
    return replace(pose, timestep=key.timestep)


def _recorded(clip: CaptureClip, key: FrameKey) -> FrameFiles:
    return clip.files[key]._replace(recorded=clip.recorded(key))
