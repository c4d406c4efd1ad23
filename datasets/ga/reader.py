"""Read a GaussianAvatars/VHAP capture, a union or a single sequence, into a `CaptureClip`.

Everything is checked before any long work: JSON keys, images, parameters, timesteps, cameras, leaks between splits.
Properties that the layout does not define (origin of ``cy``, teeth, shifted worlds) are resolved as documented for the
arguments, and recorded in the clip's first step.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ...bench.contracts import FrameKey, HeadPose, Progress, StepRecord, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_name, digest
from ...bench.io.images import ImageInfo
from ..clip import CaptureClip, FrameFiles
from ..head.arrays import HeadArrays, in_memory
from ..images import ImageStore
from ..open import MONOCULAR, describe
from ..steps.exclude import exclude_given, exclude_timesteps
from ..steps.masks import check_colour, mask_below_neck, set_background
from . import layout
from .cameras import CaptureCameras, collect_cameras, settle_cy
from .tracking import TeethPolicy, Tracking, check_version, read_head_model, read_tracking
from .transforms import RAISED, Faults, FrameEntry, read_transforms
from .validate import (
    LeakPolicy,
    check_disjoint,
    check_images,
    check_leaks,
    check_timesteps,
    digests_below,
    find_leaks,
    sequence_names,
    split_by_holding_out,
)

WHITE = (1.0, 1.0, 1.0)


def read_capture(
    path: str | Path,
    *,
    head: HeadArrays | str | Path | None = None,
    masks: str | Path | None = None,
    regions: str | Path | None = None,
    eyelids: str | Path | None = None,
    subject: str = "",
    cy: layout.CyConvention | Literal["auto"] = "auto",
    teeth: TeethPolicy = "auto",
    background: Sequence[float] | None = None,
    below_neck: bool = True,
    held_out_sequences: Sequence[str] = (),
    held_out_cameras: Sequence[str] = (),
    exclude: Mapping[int, str] | str | Path | None = None,
    leaks: LeakPolicy = "error",
    decode: bool = False,
    cache_mb: float = 512.0,
    use_cache: bool = True,
    progress: Progress = no_progress,
) -> CaptureClip:
    """Read a capture folder (or the folder that holds its one union).

    The first call reads every file once for the fingerprint and keeps the digests in the user's cache, see
    `content_digests`. Images are compared between splits by their bytes at every call.

    Parameters
    ----------
    head, masks, regions, eyelids : HeadArrays | str | Path | None
        Head model or its file, and the files that belong to it. None finds them: the head model in the
        capture, the others beside the head model.
    subject : str
        Subject id; "" takes it from ``headbench.json`` or the folder's name.
    cy : layout.CyConvention | Literal['auto']
        Convention of the principal point. "auto" takes the one that ``headbench.json`` declares, else
        compares the tracked mesh with the masks; an `InputError` is raised if the images are inconclusive and it makes
        a difference. "centre" puts the principal point at the image centre, as GaussianAvatars does.
    teeth : TeethPolicy
        "auto" adds GaussianAvatars' teeth to every head model without teeth where its lips allow it, "add" requires
        them, "keep" does not change the head model.
    background : Sequence[float] | None
        (r, g, b) in [0, 1]; None takes the declared one, else white. In images without alpha it is replaced using
        their masks.
    below_neck : bool
        Whether to keep pixels below the tracked neck; False turns them into background.
    held_out_sequences, held_out_cameras : Sequence[str]
        Define new splits instead of those of the JSONs: all frames of these sequences (full names or
        unique prefixes) are self-reenactment, these cameras' other frames novel view, the rest
        training.
    exclude : Mapping[int, str] | str | Path | None
        Frames to leave out in addition to those of ``headbench.json``: reason by timestep, or a file
        such as ``headbench prepare tongue`` writes.
    leaks : LeakPolicy
        "error" refuses splits that share data; "record" only notes it in the step record.
    decode : bool
        Whether to decode every image when checking; finds damage in the middle of files.
    cache_mb : float
        Maximum memory for decoded images, in 10^6 bytes.
    use_cache : bool
        Whether to reuse cached digests of files that have not changed since. ``headbench verify``
        sets it to False.
    """
    content = read_content(
        find_capture(path),
        *(head, subject, {"masks": masks, "regions": regions, "eyelids": eyelids}),
        resplit=bool(held_out_sequences or held_out_cameras),
        decode=decode,
        progress=progress,
    )
    assert content.head is not None, "errors are raised"
    tracking = read_tracking(content.parameter_files, content.head, content.subject, teeth=teeth)
    clip = build_clip(
        content,
        tracking,
        cy=cy,
        background=background,
        below_neck=below_neck,
        held_out_sequences=held_out_sequences,
        held_out_cameras=held_out_cameras,
        leaks=leaks,
        cache_mb=cache_mb,
        use_cache=use_cache,
        progress=progress,
    )
    return exclude_given(clip, exclude)


@dataclass(frozen=True, eq=False)
class CaptureContent:
    """Content of a capture's files except parameters and pixels."""

    folder: Path
    declaration: layout.Declaration | None
    splits: Mapping[str, Sequence[FrameEntry]]
    infos: Mapping[Path, ImageInfo]
    """Headers of images and masks."""
    rig: CaptureCameras | None
    """None if there is an error in its frames."""
    head: HeadArrays | None
    """None if there is an error in its file."""
    subject: str

    @property
    def entries(self) -> list[FrameEntry]:
        """Frames of all splits."""
        return [entry for frames in self.splits.values() for entry in frames]

    @property
    def parameter_files(self) -> dict[int, Path]:
        """Parameter file of each timestep, of its first frame."""
        return {entry.timestep: entry.parameters for entry in reversed(self.entries)}


def read_content(
    folder: Path,
    head: HeadArrays | str | Path | None = None,
    subject: str = "",
    files: Mapping[str, str | Path | None] | None = None,
    *,
    resplit: bool = False,
    decode: bool = False,
    faults: Faults = RAISED,
    progress: Progress = no_progress,
) -> CaptureContent:
    """Read and check the files of a capture, without parameters; arguments as of `read_capture`.

    If ``faults`` collects them, the first one is the error that `read_capture` raises, and the rest is read as far as
    possible.

    ``resplit``: Whether splits are not those of the JSONs.
    """
    declaration, asset, rig = None, None, None
    with faults.of("declaration"):
        declaration = layout.Declaration.read(folder)
    splits = _read_splits(folder, resplit, faults)
    entries = [entry for frames in splits.values() for entry in frames]
    with faults.of("check"):
        check_timesteps(folder, entries)
    infos = check_images(entries, decode=decode, faults=faults, progress=progress)
    with faults.of("check"):
        rig = collect_cameras([entry for entry in entries if entry.image in infos], infos)
    with faults.of("head"):
        asset = read_head_model(folder, declaration, head, **files or {})
        check_version(folder, declaration, asset)
    if entries:
        sequence_subject, _ = layout.parse_sequence_folder(entries[0].sequence_folder)
        named = layout.parse_union_folder(folder.name) or sequence_subject or folder.name
        with faults.of("check"):
            subject = check_name(
                subject or (declaration.subject if declaration else named), folder, "subject"
            )
    return CaptureContent(folder, declaration, splits, infos, rig, asset, subject)


def build_clip(
    content: CaptureContent,
    tracking: Tracking,
    *,
    cy: layout.CyConvention | Literal["auto"] = "auto",
    background: Sequence[float] | None = None,
    below_neck: bool = True,
    held_out_sequences: Sequence[str] = (),
    held_out_cameras: Sequence[str] = (),
    leaks: LeakPolicy = "error",
    cache_mb: float = 512.0,
    use_cache: bool = True,
    progress: Progress = no_progress,
) -> CaptureClip:
    """Clip of content without errors; arguments as of `read_capture`, which it raises the remaining errors of."""
    folder, declaration, entries, infos = content.folder, content.declaration, content.entries, content.infos
    rig, subject = content.rig, content.subject
    assert rig is not None, "there are no errors"
    ground, wanted = _backgrounds(folder, declaration, background, entries, infos)
    poses = _shift_poses(tracking, rig, entries)
    declared = declaration.cy if declaration else None
    convention, basis = settle_cy(folder, cy, declared, rig, tracking, poses, entries, ground)

    names = sequence_names(entries, declaration.sequences if declaration else {})
    splits, frames = _index_frames(folder, subject, names, content.splits, infos)
    if held_out_sequences or held_out_cameras:
        splits = split_by_holding_out(folder, frames, held_out_sequences, held_out_cameras)
    # All files of the clip except the head model, which may be elsewhere and has its own digest.
    used = {file for e in entries for file in (e.file, e.image, e.mask, e.parameters) if file is not None}
    images = {FrameKey(subject, names[e.sequence_folder], e.timestep, e.camera_id): e.image for e in entries}
    contents = digests_below(folder, used, use_cache=use_cache, progress=progress)
    if declaration:
        ordered = sorted(entries, key=lambda e: e.timestep)
        folders = dict.fromkeys(e.sequence_folder for e in ordered)
        contents[layout.DECLARATION_FILE] = declaration.digest(folders)
    record = {
        "cy": convention,
        "cy_from": basis,
        "sequence_shifts_m": {names[k]: v.tolist() for k, v in rig.shifts.items() if v.any()},
        "held_out_sequences": list(held_out_sequences),
        "held_out_cameras": list(held_out_cameras),
        "leaks": check_leaks(folder, find_leaks(splits, images, progress=progress), leaks),
        "synthetic": dict(declaration.synthetic) if declaration else {},
        **({"cut": declaration.cut} if declaration and declaration.cut else {}),
        **tracking.notes,
    }
    fingerprint = tracking.head.fingerprint()
    source = digest(fingerprint, contents, subject)
    clip = CaptureClip(
        subject=subject,
        head=in_memory(tracking.head, fingerprint),
        shape=tracking.shape,
        static_offset=tracking.static_offset,
        cameras=rig.resolve(convention),
        poses=poses,
        splits=splits,
        excluded={},
        background=np.array(ground),
        steps=(StepRecord("read_capture", record, source),),
        files=frames,
        source_fingerprint=source,
        store=ImageStore(cache_mb),
    )
    clip = set_background(clip, wanted)
    if not below_neck:
        clip = mask_below_neck(clip)
    if declaration and declaration.excluded:
        clip = exclude_timesteps(clip, declaration.excluded, source=folder / layout.DECLARATION_FILE)
    return clip


def find_captures(root: Path) -> list[Path]:
    """Captures under ``root``: the folder itself if it holds transforms JSONs, else its union folders."""
    expected = "a folder with a capture in the GaussianAvatars/VHAP layout"
    if not root.exists():
        raise InputError(root, "", expected, "no such folder")
    if any((root / file).exists() for file in (*layout.SPLIT_FILES.values(), layout.ALL_FRAMES_FILE)):
        if (root / "flame" / "exp").is_dir() and not (root / layout.TRACKING_FOLDER).is_dir():
            raise InputError(
                root, "", expected, "a capture of INSTA, whose JSONs have the same names", MONOCULAR
            )
        return [root]
    captures = sorted(path.parent for path in root.glob(f"UNION*/{layout.SPLIT_FILES['train']}"))
    if not captures:
        raise InputError(root, "", expected, *describe(root))
    return captures


def find_capture(path: str | Path) -> Path:
    """The only capture at ``path``."""
    folder = Path(os.path.realpath(path))  # neither "." nor a link names a subject or sequence
    captures = find_captures(folder)
    if len(captures) != 1:
        found = ", ".join(capture.name for capture in captures)
        expected = "one capture in the GaussianAvatars/VHAP layout"
        raise InputError(path, "", expected, found, "Name one capture.")
    return captures[0]


def listed_frames(path: str | Path) -> dict[str, list[tuple[int, str]]]:
    """Timestep and camera of every frame of ``transforms_{train,val,test}.json``, in their order."""
    files = (find_capture(path) / file for file in layout.SPLIT_FILES.values())
    listed = {file.stem: read_transforms(file) for file in files if file.exists()}
    return {
        name.removeprefix("transforms_"): [(entry.timestep, entry.camera_id) for entry in entries]
        for name, entries in listed.items()
    }


def pose_files(path: str | Path) -> dict[int, Path]:
    """The ``flame_param`` file of every timestep of a capture."""
    folder = find_capture(path)
    files = [folder / file for file in layout.SPLIT_FILES.values() if (folder / file).exists()]
    entries = [
        entry for file in files or [folder / layout.ALL_FRAMES_FILE] for entry in read_transforms(file)
    ]
    return {entry.timestep: entry.parameters for entry in entries}


def _read_splits(folder: Path, resplit: bool, faults: Faults) -> dict[str, list[FrameEntry]]:
    """Entries by split name; with ``resplit``, ``transforms.json`` may replace the three files."""
    paths = {name: folder / file for name, file in layout.SPLIT_FILES.items()}
    if not any(path.exists() for path in paths.values()):
        entries = {"train": read_transforms(folder / layout.ALL_FRAMES_FILE, faults)}
        with faults.of("check"):
            if not resplit:
                remedy = "Splits are made by reader_settings.held_out_sequences and .held_out_cameras."
                expected = "a file for each split"
                raise InputError(paths["train"], "", expected, f"{layout.ALL_FRAMES_FILE} alone", remedy)
        return entries
    entries = {name: read_transforms(path, faults) for name, path in paths.items()}
    with faults.of("check"):
        if not entries["train"]:
            raise InputError(paths["train"], "frames", "at least one training frame", "an empty list")
    return entries


def _backgrounds(
    folder: Path,
    declaration: layout.Declaration | None,
    wanted: Sequence[float] | None,
    entries: Sequence[FrameEntry],
    infos: Mapping[Path, ImageInfo],
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Background of the stored images and of the clip; they differ if images are already composited."""
    declared = declaration.background if declaration else WHITE
    if wanted is None:
        return declared, declared
    colour = tuple(check_colour(wanted).tolist())
    if colour == declared or all(infos[entry.image].has_alpha for entry in entries):
        return colour, colour
    bare = [entry.image for entry in entries if entry.mask is None and not infos[entry.image].has_alpha]
    if bare:
        expected = f"{declared}, which images are composited on, where one has neither mask nor alpha"
        raise InputError(folder, "background", expected, f"{colour}, and no mask for {bare[0].name}")
    return declared, colour


def _shift_poses(
    tracking: Tracking, rig: CaptureCameras, entries: Iterable[FrameEntry]
) -> dict[int, HeadPose]:
    """Poses moved into the first sequence's world."""
    folders = {entry.timestep: entry.sequence_folder for entry in entries}
    poses = {}
    for timestep, pose in tracking.poses.items():
        shift = rig.shifts[folders[timestep]].astype(pose.translation.dtype)
        poses[timestep] = replace(pose, translation=pose.translation + shift)
    return poses


def _index_frames(
    folder: Path,
    subject: str,
    names: Mapping[str, str],
    entries: Mapping[str, Sequence[FrameEntry]],
    infos: Mapping[Path, ImageInfo],
) -> tuple[dict[str, tuple[FrameKey, ...]], dict[FrameKey, FrameFiles]]:
    """Keys by split according to the JSONs, and files by key. Without a mask, the alpha channel is the mask."""
    splits: dict[str, tuple[FrameKey, ...]] = {}
    frames: dict[FrameKey, FrameFiles] = {}
    for part, group in entries.items():
        keys = [FrameKey(subject, names[e.sequence_folder], e.timestep, e.camera_id) for e in group]
        splits[part] = tuple(keys)
        for key, entry in zip(keys, group):
            own_alpha = entry.image if infos[entry.image].has_alpha else None
            frames[key] = FrameFiles(entry.image, entry.mask or own_alpha)
    check_disjoint(folder, splits)
    return splits, frames
