"""Read a tracked video as a clip: one camera, the last frames held out for self-reenactment, no novel views.

The layouts are those of `insta` and `imavatar`. VHAP's monocular export has GaussianAvatars' layout and is
read by the reader ``ga``.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ...bench.contracts import FrameKey, Progress, StepRecord, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_name, digest, entries
from ..clip import CaptureClip, FrameFiles, FramePixels
from ..ga.content_digests import content_digests
from ..ga.layout import DECLARATION_FILE, HEAD_FILE, Declaration
from ..ga.tracking import TeethPolicy, check_motion, find_head, resolve_teeth
from ..ga.validate import check_disjoint, split_by_holding_out
from ..head.arrays import HeadArrays
from ..images import ImageStore
from ..steps.exclude import exclude_given, exclude_timesteps
from ..steps.masks import check_colour, composite
from .imavatar import PARAMETERS, read_imavatar, videos
from .insta import is_insta, read_insta
from .track import Track, fix_camera

log = logging.getLogger(__name__)

CONVENTION = 350
"""Frames held out at the end of a video, by INSTA's script and by GaussianBlendshapes' loader."""
HELD_OUT_SUFFIX = "-held-out"
"""Suffix of the sequence that holds the held-out frames of a training video."""
SHORT, SHORT_SHARE = 2 * CONVENTION, 4
"""A video with fewer frames than the first number holds out the second fraction, since 350 would be most of
it."""


def find_videos(root: Path) -> list[Path]:
    """Subjects under ``root``: the folder itself, or its subfolders; an IMavatar subject contains its videos."""
    if is_insta(root) or videos(root):
        return [root]
    if not root.is_dir():
        return []
    below = [path for path in entries(root) if path.is_dir()]
    return [path for path in below if is_insta(path) or (not (path / PARAMETERS).exists() and videos(path))]


def read_video(
    path: str | Path,
    *,
    head: HeadArrays | str | Path | None = None,
    masks: str | Path | None = None,
    regions: str | Path | None = None,
    eyelids: str | Path | None = None,
    subject: str = "",
    teeth: TeethPolicy = "auto",
    background: Sequence[float] | None = None,
    held_out_frames: int | None = None,
    held_out_sequences: Sequence[str] = (),
    exclude: Mapping[int, str] | str | Path | None = None,
    cache_mb: float = 512.0,
    use_cache: bool = True,
    progress: Progress = no_progress,
) -> CaptureClip:
    """Read a tracked video, or all videos of one subject in IMavatar's layout.

    Timesteps number the frames in the order of their names, one video after the other. Held-out frames of a training
    video become a separate sequence, ``video-held-out``.

    Parameters
    ----------
    head, masks, regions, eyelids : HeadArrays | str | Path | None
        Head model that the video was tracked with, usually FLAME 2020, and the files that belong to it, which are
        found beside it.
    subject : str
        Subject id; "" takes it from ``headbench.json`` or the folder's name.
    teeth : TeethPolicy
        As for the reader ``ga``.
    background : Sequence[float] | None
        (r, g, b) in [0, 1] that straight alpha and masked images are composited on; None takes the
        declared one, else white.
    held_out_frames : int | None
        Number of last frames for self-reenactment. None takes the split of the folder, else 350, or a
        quarter of a video with fewer than 700 frames.
    held_out_sequences : Sequence[str]
        Names of the videos for self-reenactment, instead of the last frames.
    exclude, cache_mb, use_cache : Mapping[int, str] | str | Path | None, float, bool
        As for the reader ``ga``.

    Raises
    ------
    InputError
        The first fault found.
    """
    root = Path(os.path.abspath(path))
    declaration = Declaration.read(root)
    asset = _find_head(root, declaration, head, masks=masks, regions=regions, eyelids=eyelids)
    track = _read_track(root, asset, progress)
    subject = check_name(subject or (declaration.subject if declaration else root.name), root, "subject")
    for frame in track.frames:
        check_name(frame.sequence, root, "video")
    camera, poses = fix_camera(track.frames, asset, track.shape, subject)
    first = track.frames[0]
    toothed, _ = resolve_teeth(asset, len(asset.template), teeth, first.where[0])
    static_offset = np.zeros((len(toothed.template), 3), np.float32)
    sources = {index: frame.where[0] for index, frame in enumerate(track.frames)}
    check_motion(sources, toothed, track.shape, static_offset, poses)

    keys = [FrameKey(subject, f.sequence, index, camera.id) for index, f in enumerate(track.frames)]
    splits, held_out = _split(root, keys, track, held_out_frames, held_out_sequences)
    names = _sequences(splits)
    splits = {name: tuple(names[key] for key in part) for name, part in splits.items()}
    check_disjoint(root, splits)
    files = {names[key]: FrameFiles(frame.image, frame.mask) for key, frame in zip(keys, track.frames)}
    used = {*track.files, *(file for frame in track.frames for file in (frame.image, frame.mask))}
    used |= {root / DECLARATION_FILE} if declaration else set()
    digests = content_digests(used, cached_for=root if use_cache else None, progress=progress)
    contents = {Path(os.path.relpath(file, root)).as_posix(): value for file, value in digests.items()}
    declared = declaration.background if declaration else (1.0, 1.0, 1.0)
    ground = check_colour(declared if background is None else background)
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
        files=files,
        source_fingerprint=source,
        store=ImageStore(cache_mb),
    )
    clip = _masked(clip, track.hard_masks)
    if declaration and declaration.excluded:
        clip = exclude_timesteps(clip, declaration.excluded, source=root / DECLARATION_FILE)
    return exclude_given(clip, exclude)


def _find_head(
    root: Path,
    declaration: Declaration | None,
    head: HeadArrays | str | Path | None,
    **files: str | Path | None,
) -> HeadArrays:
    if head is None and declaration is None and not (root / HEAD_FILE).exists():
        raise InputError(
            root,
            "head",
            f"the head model that the video was tracked with, or {HEAD_FILE} in the folder",
            "none",
            "Give it as head= (`headbench run`: --head): Metrical Tracker and IMavatar track with FLAME 2020, "
            "generic_model.pkl from https://flame.is.tue.mpg.de.",
        )
    return find_head(root, declaration, head, **files)


def _read_track(root: Path, head: HeadArrays, progress: Progress) -> Track:
    if is_insta(root):
        return read_insta(root, head, progress)
    if videos(root):
        return read_imavatar(root, head, progress)
    expected = f"INSTA's folder (transforms_train.json, flame/exp) or IMavatar's ({PARAMETERS})"
    raise InputError(root, "", expected, "neither")


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


def _masked(clip: CaptureClip, hard: bool) -> CaptureClip:
    """Composite images with a visible room behind the subject using their masks."""
    bare = frozenset(key for key, files in clip.files.items() if files.image != files.mask)
    if not bare:
        return clip
    colour = np.asarray(clip.background, np.float32)

    def change(key: FrameKey, pixels: FramePixels) -> FramePixels:
        if key not in bare or pixels.coverage is None:
            return pixels
        coverage = (pixels.coverage > 0.5).astype(np.float32) if hard else pixels.coverage
        return FramePixels(composite(pixels.image, coverage, colour), coverage)

    return clip.derive_pixels("composite_by_mask", {"frames": len(bare), "hard_masks": hard}, change)
