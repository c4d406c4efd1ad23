"""Finds which cameras of self-reenactment the methods were trained on, from the records of runs.

Self-reenactment is scored at all cameras, of which most have training frames. Values at those and at held-out cameras differ by
several dB, so tables show them separately.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from ..bench.contracts import FrameKey
from ..bench.manifest import Manifest

SPLIT_TASK = "self_reenactment"


def explained(keys: Collection[FrameKey], unseen: Collection[tuple[str, str]]) -> str:
    """Describe seen and unseen cameras of the frames ``keys``, with their number if it is equal for every subject."""
    cameras = {(key.subject, key.camera) for key in keys}
    subjects = {subject for subject, _ in cameras}
    counts = {
        tuple(sum(name == subject for name, _ in group) for group in (cameras - {*unseen}, unseen))
        for subject in subjects
    }
    seen, held_out = (f" ({count} scored)" for count in counts.pop()) if len(counts) == 1 else ("", "")
    return f"Seen cameras{seen} have training frames in the capture, of other timesteps; unseen cameras{held_out} have none."


def unseen_cameras(
    manifests: Sequence[Manifest], keys: Collection[FrameKey]
) -> tuple[frozenset[tuple[str, str]], str]:
    """The (subject, camera) pairs of self-reenactment without training frames; none and a reason, one sentence, if
    they are all, none, or not the same in all runs.
    """
    unseen = set()
    cameras = {(key.subject, key.camera) for key in keys}
    for subject in {key.subject for key in keys}:
        clips = (clip for manifest in manifests for clip in manifest.clips if clip.subject == subject)
        own = {camera for name, camera in cameras if name == subject}
        seen = {frozenset(own & {*clip.training_cameras}) for clip in clips}
        if len(seen) != 1:
            return frozenset(), _one_column("the runs differ in which cameras were trained on")
        unseen |= {(subject, camera) for camera in own.difference(*seen)}
    if not unseen:
        return frozenset(), _one_column("methods are trained on all of its cameras") if keys else ""
    if len(unseen) == len(cameras):
        return frozenset(), _one_column("methods are trained on none of its cameras")
    return frozenset(unseen), ""


def _one_column(why: str) -> str:
    return f"Self-reenactment is not split into seen and unseen cameras: {why}."
