"""Clips of tracked videos: one camera, splits by the held-out frames, masks composited.

Common representation of tracked videos: frames with a camera and a pose each. In these layouts the head is static, or
nearly so, and every frame has its own camera. A clip has one camera and a moving head: `fix_camera` converts the former
to the latter.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ...bench.contracts import Camera, FloatArray, FrameKey, HeadPose, Progress, StepRecord, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_name, digest
from ..clip import CaptureClip, FrameFiles, FramePixels
from ..ga.tracking import TeethPolicy, check_neutral, resolve_teeth
from ..ga.validate import check_disjoint, digests_below, split_by_holding_out
from ..head.arrays import HeadArrays
from ..head.model import HeadModel
from ..head.rotations import rotation_of
from ..images import ImageStore, read_mask
from ..steps.masks import check_colour, composite

VIDEO = "video"
"""Name of the sequence where a layout names none."""
SAME_INTRINSICS = 1e-3
"""Maximum difference of the intrinsics of one camera, pixels."""


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One frame of a layout, in this project's units and axes."""

    where: tuple[Path, str]
    """File and entry, for messages."""
    sequence: str
    number: int
    """The video's name, and the frame's number in its file name."""
    image: Path
    mask: Path | None
    """Files; the mask is the image itself if that has straight alpha."""
    camera: Camera
    pose: HeadPose
    """Pose in the world that ``camera`` maps from; its timestep is not set yet."""
    inside: Path | None = None
    """A second mask; the coverage is the product of the two."""

    @property
    def name(self) -> tuple[str, int]:
        """Identity and sort key of a frame."""
        return self.sequence, self.number


@dataclass(frozen=True, eq=False)
class Track:
    """A tracked video, or several of one subject."""

    frames: Sequence[VideoFrame]
    """Sorted by `VideoFrame.name`, without duplicates."""
    shape: FloatArray
    """(S,) identity coefficients of the head model."""
    held_out: frozenset[tuple[str, int]] | None
    """Names of the frames that the layout holds out; None if it does not define a split."""
    files: frozenset[Path]
    """All files that were read, except images."""
    notes: Mapping[str, Any] = field(default_factory=dict)
    """Properties that the layout does not define, and the choices made."""
    solid: tuple[float, float] | None = None
    """Coverage range (low, high] in [0, 1] that becomes 1, all else 0, as in the layout's own loader; None keeps masks
    unchanged."""


def ordered(root: Path, frames: Sequence[VideoFrame]) -> list[VideoFrame]:
    """Frames by name."""
    if not frames:
        raise InputError(root, "frames", "at least one frame", "none")
    found: dict[tuple[str, int], VideoFrame] = {}
    for frame in frames:
        other = found.setdefault(frame.name, frame)
        if other is not frame:
            file, entry = frame.where
            expected = "every frame once"
            raise InputError(
                file, entry, expected, f"frame {frame.number} again, which is {other.where[1]} too"
            )
    return [found[name] for name in sorted(found)]


def frame_number(file: Path, entry: str, stem: str) -> int:
    """Number in the names of a frame's files."""
    if not (stem.isascii() and stem.isdecimal() and len(stem) < 10):
        raise InputError(file, entry, "files named by the frame's number, such as 00012", repr(stem)[:60])
    return int(stem)


def fix_camera(
    frames: Sequence[VideoFrame], head: HeadArrays, shape: FloatArray, subject: str
) -> tuple[Camera, dict[int, HeadPose]]:
    """The camera of the first frame, and by index the poses that give the same view in it as each frame's own camera.

    With W the camera of a frame and W0 the first, the head moves by M = W0^-1 W: its global rotation becomes R_M R, and
    since that turns about joint 0 at J (which moves with the expression) its translation R_M (J + t) + t_M - J.
    """
    first = frames[0].camera
    for frame in frames:
        camera = frame.camera
        off = float(np.abs(camera.K - first.K).max())
        if (camera.width, camera.height) != (first.width, first.height):
            expected = f"{first.width}x{first.height} pixels, as the first image of the video"
            raise InputError(frame.image, "", expected, f"{camera.width}x{camera.height}")
        if not off <= SAME_INTRINSICS:
            file, entry = frame.where
            expected = "the intrinsics of the first frame, as one camera has"
            raise InputError(file, entry, expected, f"others, by {off:g} pixels")
    model = HeadModel(head, dtype=torch.float64)
    expressions = torch.from_numpy(np.stack([frame.pose.expression for frame in frames]))
    with torch.no_grad():
        roots = model.joints(torch.from_numpy(np.asarray(shape, np.float64)), expressions)[:, 0].numpy()
    back = np.linalg.inv(first.world_to_camera)
    poses = {}
    for index, (frame, root) in enumerate(zip(frames, roots)):
        motion = back @ frame.camera.world_to_camera if index else np.eye(4)
        turn = Rotation.from_matrix(motion[:3, :3])
        pose = frame.pose
        poses[index] = HeadPose(
            head_model=pose.head_model,
            expression=pose.expression,
            rotation=(turn * rotation_of(pose.rotation)).as_rotvec(),
            neck=pose.neck,
            jaw=pose.jaw,
            eyes=pose.eyes,
            translation=turn.apply(root + pose.translation) + motion[:3, 3] - root,
            eyelids=pose.eyelids,
            subject=subject,
            timestep=index,
        )
    return first, poses


def coefficients(file: Path, entry: str, values: FloatArray, size: int) -> FloatArray:
    """Coefficients as a vector of ``size``: padded with zeros, or truncated if the remainder is zero."""
    if np.any(values[size:]):
        expected = f"at most {size} coefficients, which the head model has, or zeros behind them"
        remedy = "Give the head model the video was tracked with."
        raise InputError(file, entry, expected, f"{len(values)}", remedy)
    kept = values[:size]
    return np.pad(kept, (0, size - len(kept)))


def rotations_of_6d(file: Path, entry: str, rows: FloatArray) -> FloatArray:
    """(N, 3) axis-angle of (N, 6) rotations that are the first two rows of a matrix, made orthonormal in order."""
    first, second = rows[:, :3], rows[:, 3:]
    normal = np.cross(first, second)
    if np.linalg.norm(normal, axis=1).min() < 1e-6:
        raise InputError(file, entry, "6D rotations: two vectors of different directions", "none")
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    third = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    matrices = np.stack([first, np.cross(third, first), third], axis=1)
    return Rotation.from_matrix(matrices).as_rotvec()


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

    ``root``: The folder that paths are relative to, for messages and digests. ``head``: Head model of the track.
    ``subject``, ``teeth``, ``background``, ``held_out_frames``, ``held_out_sequences``, ``cache_mb``, ``use_cache``: As for
    `reader.read_video`. ``files``: Files besides those of the track that the clip depends on.
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


def check_frame_count(video: Path, count: int, held_out: int | None, tolerance: int = 0) -> None:
    """Raise `InputError` for a video with too few frames to train on some and hold out others.

    ``tolerance``: Number of frames by which ``count`` may be too small.
    """
    least = SHORT_SHARE if held_out is None else held_out + 1
    if count + tolerance < least:
        raise InputError(
            video, "frames", f"at least {least} with a face, to hold out {held_out or 1}", str(count)
        )


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
