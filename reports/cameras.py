"""Finds which cameras of self-reenactment the methods were trained on, from the records of runs.

Self-reenactment is scored at all cameras, of which most have training frames. Values at those and at held-out cameras differ by
several dB, so tables show them separately.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from ..bench.contracts import FrameKey
from ..bench.manifest import ClipRecord, Manifest

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
    """The (subject, camera) pairs of self-reenactment without training frames; none and a reason if unknown.

    The reason is one sentence, for captions.
    """
    unseen = set()
    cameras = {(key.subject, key.camera) for key in keys}
    for subject in {key.subject for key in keys}:
        found = [
            _seen(manifest, clip, {camera for name, camera in cameras if name == subject})
            for manifest in manifests
            for clip in manifest.clips
            if clip.subject == subject
        ]
        known = {frozenset(seen) for seen in found if seen is not None}
        if len(known) != 1:
            what = "differ in" if known else "do not record"
            return frozenset(), _one_column(f"the runs {what} which cameras were trained on")
        (seen,) = known
        unseen |= {(name, camera) for name, camera in cameras if name == subject and camera not in seen}
    if not unseen:
        return frozenset(), _one_column("methods are trained on all of its cameras") if keys else ""
    if len(unseen) == len(cameras):
        return frozenset(), _one_column("methods are trained on none of its cameras")
    return frozenset(unseen), ""


def _one_column(why: str) -> str:
    return f"Self-reenactment is not split into seen and unseen cameras: {why}."


def _seen(manifest: Manifest, clip: ClipRecord, cameras: set[str]) -> set[str] | None:
    """The training cameras among a subject's ``cameras``; None if they are not recorded."""
    if clip.training_cameras:
        return cameras & {*clip.training_cameras}
    # Older records have no cameras: novel views are the frames of all held-out cameras.
    views = manifest.protocols.get("novel_view")
    own = [key for key in views.keys if key.subject == clip.subject] if views else []
    if len(own) != clip.splits.get("novel_view", 0):
        return None  # Only some frames were scored, perhaps not of every held-out camera.
    return cameras - {key.camera for key in own}
