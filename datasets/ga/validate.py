"""Checks of a capture as a whole, made before any long work: images, timesteps, split leaks.

Each fault is one `InputError` that names the file, the entry, what was expected and what was found.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Literal

from ...bench.contracts import FrameKey, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.images import ImageInfo, probe_image
from .content_digests import content_digests
from .transforms import FrameEntry, timesteps_of

LeakPolicy = Literal["error", "record"]


def check_images(
    entries: Sequence[FrameEntry], *, decode: bool = False, progress: Progress = no_progress
) -> dict[Path, ImageInfo]:
    """Make sure that every image and mask is there, whole, and of the size its frame declares.

    Parameters
    ----------
    decode : decode every file too, which finds damage in the middle (minutes for a large capture).

    Returns
    -------
    What the header of each image says, by path; masks are checked and not listed.
    """
    infos: dict[Path, ImageInfo] = {}
    for done, entry in enumerate(entries, start=1):
        info = _probe_referenced(entry, entry.image, "file_path", decode)
        width, height = entry.width or info.width, entry.height or info.height
        _check_size(entry, entry.image, info, width, height)
        infos[entry.image] = info
        if entry.mask is not None:
            _check_size(
                entry, entry.mask, _probe_referenced(entry, entry.mask, "fg_mask_path", decode), width, height
            )
        progress(done, len(entries), "checking images")
    return infos


def _probe_referenced(entry: FrameEntry, path: Path, key: str, decode: bool) -> ImageInfo:
    if not os.path.exists(path):  # unlike Path.exists, False for names no file can have
        raise InputError(entry.file, f"{entry.where}.{key}", "an existing file", f"no {path}")
    return probe_image(path, decode=decode)


def _check_size(entry: FrameEntry, path: Path, info: ImageInfo, width: int, height: int) -> None:
    if (info.width, info.height) != (width, height):
        expected = f"{width}x{height} pixels as {entry.file.name} {entry.where} says"
        raise InputError(path, "", expected, f"{info.width}x{info.height}")


def check_timesteps(folder: Path, entries: Sequence[FrameEntry]) -> None:
    """Make sure that timesteps run from 0 without a gap, each with one parameter file and one sequence.

    Readers of the layout index arrays by timestep, so a gap shifts every parameter behind it.
    """
    timesteps = timesteps_of(entries)
    if not entries:
        raise InputError(folder, "frames", "at least one frame", "none")
    if timesteps != [*range(len(timesteps))]:
        gap = next(i for i, t in enumerate(timesteps) if i != t)
        found = f"no frame of timestep {gap}, though timesteps reach {timesteps[-1]}"
        raise InputError(folder, "timestep_index", "timesteps that count from 0 without a gap", found)
    first: dict[int, FrameEntry] = {}
    for entry in entries:
        other = first.setdefault(entry.timestep, entry)
        if (entry.parameters, entry.sequence_folder) != (other.parameters, other.sequence_folder):
            raise InputError(
                entry.file,
                f"{entry.where}.flame_param_path",
                f"{other.parameters.name} of {other.sequence_folder}, as for timestep {entry.timestep} elsewhere",
                f"{entry.parameters.name} of {entry.sequence_folder}",
            )


def find_leaks(
    splits: Mapping[str, Sequence[FrameKey]],
    images: Mapping[FrameKey, Path],
    *,
    progress: Progress = no_progress,
) -> list[str]:
    """Ways in which held-out data is seen in training, one sentence each; empty where there is none.

    Looks for one image file or one image content in two splits, for self-reenactment timesteps among the
    training timesteps, and for novel-view cameras among the training cameras. Contents are read from the files
    at each call, but only of images that have their size in common with one of another split.
    """
    contents = _contents(splits, images, progress)
    found = []
    for one, other in combinations(splits, 2):
        names = f"{one} and {other}"
        shared = _common({images[key] for key in splits[one]}, {images[key] for key in splits[other]})
        if shared:
            found.append(f"{len(shared)} image files are in both {names}, such as {shared[0]}")
            continue
        by_content = {contents[images[key]]: key for key in splits[one] if images[key] in contents}
        equal = [key for key in splits[other] if contents.get(images[key]) in by_content]
        if equal:
            first = by_content[contents[images[equal[0]]]]
            found.append(
                f"{len(equal)} images have the same content in {names}, such as {first} and {equal[0]}"
            )
    train = splits.get("train", ())
    timesteps = _common({k.timestep for k in train}, {k.timestep for k in splits.get("self_reenactment", ())})
    if timesteps:
        found.append(f"{len(timesteps)} self-reenactment timesteps are trained on, such as {timesteps[0]}")
    cameras = _common({k.camera for k in train}, {k.camera for k in splits.get("novel_view", ())})
    if cameras:
        found.append(f"novel-view cameras are trained on: {', '.join(map(str, cameras))}")
    return found


def _contents(
    splits: Mapping[str, Sequence[FrameKey]], images: Mapping[FrameKey, Path], progress: Progress
) -> dict[Path, str]:
    """Digest of each image that may have the content of one in another split, having its size."""
    split_of_size: dict[int, set[str]] = {}
    sizes: dict[Path, int] = {}
    for split, keys in splits.items():
        for path in {images[key] for key in keys}:
            sizes[path] = path.stat().st_size
            split_of_size.setdefault(sizes[path], set()).add(split)
    candidates = [path for path, size in sizes.items() if len(split_of_size[size]) > 1]
    return content_digests(candidates, progress=progress)


def _common(one: set, other: set) -> list:
    return sorted(one & other)


def check_leaks(folder: Path, leaks: Iterable[str], policy: LeakPolicy) -> list[str]:
    """Raise `InputError` for the leaks `find_leaks` found, or under ``"record"`` return them."""
    leaks = list(leaks)
    if leaks and policy == "error":
        raise InputError(
            folder,
            "splits",
            "splits that share nothing",
            "; ".join(leaks),
            'Mend the split, or read with leaks="record" to have this noted in every result.',
        )
    return leaks
