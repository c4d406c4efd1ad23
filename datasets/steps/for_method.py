"""A clip in the form that a method needs: the steps that lead there, in order, and the way back.

Found by the harness as the entry point of `headbench.adaptation`, see `headbench.bench.runner.adaptation`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from ...bench.contracts import Clip, FloatArray, FrameKey, Progress
from ...bench.errors import InputError
from ...bench.runner.adaptation import Adaptation, AdaptedClip, MethodNeeds
from ..clip import CaptureClip, as_capture
from ..ga.head import find_head
from ..head.arrays import HeadArrays
from ..head.procedural.model import VERSIONS, procedural_head
from ..head.refit.refit import refit_clip
from .monocular import as_single_video
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
