"""Clips of tracked videos: one camera, splits by the held-out frames, masks composited."""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray, FrameKey, Progress, StepRecord, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_name, digest
from ..clip import CaptureClip, FrameFiles, FramePixels
from ..ga.content_digests import digests_below
from ..ga.tracking import TeethPolicy, check_neutral, resolve_teeth
from ..ga.validate import check_disjoint, split_by_holding_out
from ..head.arrays import HeadArrays
from ..images import ImageStore, read_mask
from ..steps.masks import check_colour, composite
from .track import Track, fix_camera

log = logging.getLogger(__name__)

WHITE = (1.0, 1.0, 1.0)
CONVENTION = 350
"""Frames held out at the end of a video, by INSTA's script and by GaussianBlendshapes' loader."""
HELD_OUT_SUFFIX = "-held-out"
"""Suffix of the sequence that holds the held-out frames of a training video."""
SHORT, SHORT_SHARE = 2 * CONVENTION, 4
"""A video with fewer frames than the first number holds out the second fraction, since 350 would be most of
it."""


def subject_of(path: Path) -> str:
    """A name of a subject from that of a file or folder."""
    return re.sub(r"[^\w.+-]|_", "-", path.stem if path.is_file() else path.name).lstrip(".-") or "subject"


def check_subject(name: str, option: str) -> None:
    """Raise `InputError` for a name that folders of captures cannot have."""
    check_name(name, "command line", option)
    if "_" in name:
        expected = "a name without underscores, which separate the parts of the names of folders"
        raise InputError("command line", option, expected, repr(name))


def clip_of_track(
    root: Path,
    track: Track,
    head: HeadArrays,
    *,
    subject: str,
    teeth: TeethPolicy = "auto",
    background: Sequence[float] = WHITE,
    held_out_frames: int | None = None,
    held_out_sequences: Sequence[str] = (),
    files: Collection[Path] = (),
    cache_mb: float = 512.0,
    use_cache: bool = True,
    progress: Progress = no_progress,
) -> CaptureClip:
    """The clip of a tracked video.

    Parameters
    ----------
    root : Path
        The folder that paths are relative to, for messages and digests.
    head : HeadArrays
        Head model of the track.
    subject, teeth, background, held_out_frames, held_out_sequences, cache_mb, use_cache : Any
        As for `reader.read_video`.
    files : Collection[Path]
        Files besides those of the track that the clip depends on.
    """
    for frame in track.frames:
        check_name(frame.sequence, root, "video")
    camera, poses = fix_camera(track.frames, head, track.shape, subject)
    first = track.frames[0]
    toothed, _ = resolve_teeth(head, len(head.template), teeth, first.where[0])
    static_offset = np.zeros((len(toothed.template), 3), np.float32)
    check_neutral(first.where[0], toothed, track.shape, static_offset)

    keys = [FrameKey(subject, f.sequence, index, camera.id) for index, f in enumerate(track.frames)]
    splits, held_out = _split(root, keys, track, held_out_frames, held_out_sequences)
    names = _sequences(splits)
    splits = {name: tuple(names[key] for key in part) for name, part in splits.items()}
    check_disjoint(root, splits)
    pixels = {names[key]: FrameFiles(frame.image, frame.mask) for key, frame in zip(keys, track.frames)}
    used = {*track.files, *files}
    used |= {file for frame in track.frames for file in (frame.image, frame.mask, frame.inside) if file}
    contents = digests_below(root, used, use_cache=use_cache, progress=progress)
    ground = check_colour(background)
    source = digest(toothed.fingerprint(), contents, subject, ground)
    record = {
        "held_out": held_out,
        "novel_view": "none: a video of one camera has no view to hold out",
        "teeth": len(toothed.regions.get("teeth", ())),
        **track.notes,
    }
    clip = CaptureClip(
        subject=subject,
        head=toothed,
        shape=track.shape,
        static_offset=static_offset,
        cameras={camera.id: camera},
        poses=poses,
        splits=splits,
        excluded={},
        background=ground,
        steps=(StepRecord("read_video", record, source),),
        files=pixels,
        source_fingerprint=source,
        store=ImageStore(cache_mb),
    )
    inside = {names[key]: frame.inside for key, frame in zip(keys, track.frames) if frame.inside}
    return _masked(clip, track.solid, inside)


def _split(
    root: Path, keys: Sequence[FrameKey], track: Track, frames: int | None, sequences: Sequence[str]
) -> tuple[dict[str, tuple[FrameKey, ...]], str]:
    """Splits and a description of the held-out frames. Keys are in the order of names."""
    if frames is not None and sequences:
        raise InputError(root, "held_out_frames", "either held_out_frames or held_out_sequences", "both")
    if sequences:
        splits = split_by_holding_out(root, keys, sequences, ())
        words = f"videos {', '.join(sequences)}"
    elif frames is None and track.held_out is not None:
        held = track.held_out
        named = [(frame.sequence, frame.number) in held for frame in track.frames]
        splits = _parts(keys, named)
        words = f"{sum(named)} frames, according to the folder's split"
    else:
        count, words = _last(len(keys), frames)
        splits = _parts(keys, [index >= len(keys) - count for index in range(len(keys))])
    if not splits["train"] or not splits["self_reenactment"]:
        empty = "train" if not splits["train"] else "self_reenactment"
        raise InputError(
            root, f"splits.{empty}", "frames for training and frames held out", f"{len(keys)} in all"
        )
    log.info("%s: held out are %s", root.name, words)
    return splits, words


def _sequences(splits: Mapping[str, Sequence[FrameKey]]) -> dict[FrameKey, FrameKey]:
    """Sequence name of each frame; the held-out part of a training video is a separate sequence."""
    trained = {key.sequence for key in splits["train"]}
    names = {key: key for part in splits.values() for key in part}
    for key in splits["self_reenactment"]:
        if key.sequence in trained:
            names[key] = key._replace(sequence=f"{key.sequence}{HELD_OUT_SUFFIX}")
    return names


def _last(count: int, asked: int | None) -> tuple[int, str]:
    if asked is not None:
        return asked, f"the last {asked} frames by name, as asked for"
    if count >= SHORT:
        return CONVENTION, f"the last {CONVENTION} frames by name, as is the convention"
    held = count // SHORT_SHARE
    return held, (
        f"the last {held} frames by name, a quarter: fewer than the {CONVENTION} of the convention, "
        f"as the video has {count} frames and not {SHORT}"
    )


def _parts(keys: Sequence[FrameKey], held_out: Sequence[bool]) -> dict[str, tuple[FrameKey, ...]]:
    return {
        "train": tuple(key for key, held in zip(keys, held_out) if not held),
        "novel_view": (),
        "self_reenactment": tuple(key for key, held in zip(keys, held_out) if held),
    }


def _masked(
    clip: CaptureClip, solid: tuple[float, float] | None, inside: Mapping[FrameKey, Path]
) -> CaptureClip:
    """Composite images with a visible room behind the subject using their masks."""
    bare = frozenset(key for key, files in clip.files.items() if files.mask not in (None, files.image))
    if not bare:
        return clip
    colour = np.asarray(clip.background, np.float32)

    def change(key: FrameKey, pixels: FramePixels) -> FramePixels:
        if key not in bare or pixels.coverage is None:
            return pixels
        coverage = _hardened(pixels.coverage, solid)
        if key in inside:
            second = read_mask(inside[key], (coverage.shape[1], coverage.shape[0]))
            coverage = coverage * _hardened(second.astype(np.float32) / 255, solid)
        return FramePixels(composite(pixels.image, coverage, colour), coverage)

    parameters: dict[str, int] = {"frames": len(bare), "hard_masks": solid is not None}
    parameters |= {"second_masks": len(inside)} if inside else {}
    return clip.derive_pixels("composite_by_mask", parameters, change)


def _hardened(coverage: FloatArray, solid: tuple[float, float] | None) -> FloatArray:
    if solid is None:
        return coverage
    return ((coverage > solid[0]) & (coverage <= solid[1])).astype(np.float32)
