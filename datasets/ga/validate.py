"""Checks of a whole capture before any long work: images, timesteps, leaks between splits.

Each fault is an `InputError` with file, entry, expected and found value.

Digests of file contents, stored in the user's cache and valid while the files are unchanged. JSON, npz and text are
digested in a form that does not depend on the program that wrote the same content: white space, order of keys and
arrays, compression, 1 for 1.0, and the spelling of paths and camera ids. For files of headbench it is the file's own
bytes. Other files, such as images, are digested as they are.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ...bench.contracts import FrameKey, Progress, no_progress
from ...bench.errors import InputError, UnavailableError
from ...bench.io.arrays import read_npz
from ...bench.io.documents import read_json
from ...bench.io.files import (
    cache_folder,
    digest,
    digest_file,
    json_text,
    read_bytes,
    reading,
    with_slashes,
    write_json,
)
from ...bench.io.images import ImageInfo, probe_image
from ...bench.progress import counted
from ..clip import CaptureClip
from .layout import parse_sequence_folder
from .transforms import RAISED, Faults, FrameEntry, timesteps_of

_log = logging.getLogger(__name__)
_THREADS = 4  # hashing releases the interpreter lock; more threads help only on slow disks

YOUNG_NS = 2 * 10**9
"""Digests of files changed more recently are not stored: they may change again within the clock resolution."""


class Stamp(NamedTuple):
    """File status of the system. A program can set ``modified`` back, but not ``changed``."""

    device: int
    inode: int
    size: int
    modified: int  # ns
    changed: int  # ns

    @classmethod
    def of(cls, path: Path) -> Stamp:
        """Read the status of a file."""
        status = path.stat()
        return cls(status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)


def digest_content(path: Path) -> str:
    """Hex SHA-256 of a file's content."""
    if path.suffix == ".json":
        value = read_json(path)
        with reading(path, "JSON of usual depth"):
            content = json_text(_ordered_json(value, os.path.abspath(path.parent))).encode()
    elif path.suffix == ".npz":
        stream, arrays = io.BytesIO(), read_npz(path)
        np.savez(
            stream,
            allow_pickle=False,
            **{key: np.array(arrays[key], order="C") for key in sorted(arrays, key=_rank)},
        )
        content = stream.getvalue()
    elif path.suffix in (".obj", ".txt"):
        content = b" ".join(read_bytes(path, "text").split())
    else:
        return digest_file(path)
    return hashlib.sha256(content).hexdigest()


_ORDER = (
    *("frames", "timestep_index", "camera_index", "camera_id", "cx", "cy", "fl_x", "fl_y", "h", "w"),
    *(
        "camera_angle_x",
        "camera_angle_y",
        "transform_matrix",
        "file_path",
        "fg_mask_path",
        "flame_param_path",
    ),
    *("timestep_index_original", "timestep_id", "timestep_indices", "camera_indices"),
    *("translation", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "expr", "dynamic_offset", "eyelids"),
    *("shape", "static_offset"),
)
"""Keys of transforms JSONs and arrays of parameter files in the order in which `writer` writes them."""
_FLOATS = {"cx", "cy", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "transform_matrix"}
_LARGE = 1e300  # JSON integers have no bound
_RANKS = {key: rank for rank, key in enumerate(_ORDER)}


def _rank(key: str) -> tuple[int, str]:
    return _RANKS.get(key, len(_RANKS)), key


def _ordered_json(value: Any, folder: str, key: str = "") -> Any:
    """A value of the JSON entry ``key`` as `writer` writes it; null is no entry."""
    if isinstance(value, dict):
        kept = sorted((name for name in value if value[name] is not None), key=_rank)
        return {name: _ordered_json(value[name], folder, name) for name in kept}
    if isinstance(value, list):
        return [_ordered_json(part, folder, key) for part in value]
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        if key in _FLOATS and abs(value) < _LARGE:
            return value + 0.0  # no negative zero
        value = int(value) if isinstance(value, float) and value.is_integer() else value
        return str(value) if key == "camera_id" else value
    if key.endswith("_path") and isinstance(value, str):
        return Path(os.path.relpath(os.path.join(folder, with_slashes(value)), folder)).as_posix()
    return value


def content_digests(
    files: Iterable[Path], *, cached_for: Path | None = None, progress: Progress = no_progress
) -> dict[Path, str]:
    """`digest_content` of each file.

    ``cached_for``: The capture that the files belong to. Digests of files with an unchanged `Stamp` are taken from the
    user's cache (``digests`` of `cache_folder`, never the capture itself), and new digests are stored there. None reads
    every byte.
    """
    paths = sorted(set(files))
    place = _place(cached_for) if cached_for else None
    cached = _read_cache(place) if place else {}
    stamps = {path: Stamp.of(path) for path in paths}
    result = {path: cached[_name(stamps[path])] for path in paths if _name(stamps[path]) in cached}
    missing = [path for path in paths if path not in result]
    with ThreadPoolExecutor(_THREADS) as pool:
        for done, (path, value) in enumerate(zip(missing, pool.map(digest_content, missing)), start=1):
            result[path] = value
            progress(done, len(missing), "reading file contents")
    if place and missing:
        limit = time.time_ns() - YOUNG_NS
        settled = [path for path in paths if stamps[path].changed < limit and Stamp.of(path) == stamps[path]]
        _write_cache(place, {_name(stamps[path]): result[path] for path in settled})
    return result


def digests_of_same_size(
    splits: Mapping[str, Sequence[Path]], *, progress: Progress = no_progress
) -> dict[Path, str]:
    """Digests as by `content_digests` of the files that have the same size as one of another split. Paths that name no
    file are left out."""
    sizes = {path: path.stat().st_size for part in splits.values() for path in part if path.is_file()}
    splits_of: dict[int, set[str]] = defaultdict(set)
    for split, part in splits.items():
        for path in part:
            if path in sizes:
                splits_of[sizes[path]].add(split)
    return content_digests((p for p, size in sizes.items() if len(splits_of[size]) > 1), progress=progress)


def digests_below(
    folder: Path, files: Iterable[Path], *, use_cache: bool, progress: Progress
) -> dict[str, str]:
    """`content_digests` of a capture's files by their paths relative to its folder, such as "../a/b.png"."""
    digests = content_digests(files, cached_for=folder if use_cache else None, progress=progress)
    return {Path(os.path.relpath(file, folder)).as_posix(): value for file, value in digests.items()}


def _place(folder: Path) -> Path | None:
    """Cache file of a capture; None if the user has no home folder."""
    try:
        return cache_folder() / "digests" / f"{digest(os.path.abspath(folder), 'content')[:32]}.json"
    except UnavailableError as error:
        _log.info("digests are not stored: %s", error)
        return None


def _name(stamp: Stamp) -> str:
    return "-".join(map(str, stamp))


def _read_cache(path: Path) -> dict[str, str]:
    """Entries of the cache; none if it is missing or not written by `_write_cache`."""
    try:
        content = json.loads(path.read_bytes())
        entries: dict[str, str] = content["entries"]
        return entries if content["digest"] == digest(entries) else {}
    except (OSError, ValueError, TypeError, KeyError, IndexError, RecursionError):
        return {}


def _write_cache(path: Path, entries: dict[str, str]) -> None:
    try:
        write_json(path, {"digest": digest(entries), "entries": entries})
    except OSError as error:
        _log.info("digests are not stored, %s cannot be written: %s", path, error)


LeakPolicy = Literal["error", "record"]


def check_images(
    entries: Sequence[FrameEntry],
    *,
    decode: bool = False,
    faults: Faults = RAISED,
    progress: Progress = no_progress,
) -> dict[Path, ImageInfo]:
    """Check that every image and mask exists, is complete, and has the size declared by its frame.

    ``decode``: Whether to decode every file, which finds damage in the middle (minutes for a large capture).

    Returns
    -------
    dict[Path, ImageInfo]
        Headers of the images and masks by path.
    """
    infos: dict[Path, ImageInfo] = {}
    for done, entry in enumerate(entries, start=1):
        for path, key in ((entry.image, "file_path"), (entry.mask, "fg_mask_path")):
            if path is not None and path not in infos:
                with faults.of("file"):
                    infos[path] = _probe_referenced(entry, path, key, decode)
            if path in infos and entry.image in infos:
                with faults.of("check"):
                    _check_size(entry, path, infos[path], infos[entry.image])
        progress(done, len(entries), "checking images")
    return infos


def _probe_referenced(entry: FrameEntry, path: Path, key: str, decode: bool) -> ImageInfo:
    if not os.path.exists(path):  # unlike Path.exists, False for names no file can have
        where = f"{entry.where}.{key}"
        if not path.is_relative_to(entry.file.parent):
            remedy = "Write relative paths: absolute paths are valid only on the machine that exported the capture."
            raise InputError(entry.file, where, "a path relative to the JSON's folder", f"no {path}", remedy)
        raise InputError(entry.file, where, "an existing file", f"no {path}")
    return probe_image(path, decode=decode)


def _check_size(entry: FrameEntry, path: Path, info: ImageInfo, image: ImageInfo) -> None:
    width, height = entry.width or image.width, entry.height or image.height
    if (info.width, info.height) != (width, height):
        expected = f"{width}x{height} pixels as {entry.file.name} {entry.where} says"
        raise InputError(path, "", expected, f"{info.width}x{info.height}")


def check_timesteps(folder: Path, entries: Sequence[FrameEntry]) -> None:
    """Check that timesteps are numbered from 0 without a gap, each with one parameter file and one sequence. Readers of
    the layout index arrays by timestep, so a gap would shift all following parameters."""
    timesteps = timesteps_of(entries)
    if not entries:
        raise InputError(folder, "frames", "at least one frame", "none")
    if timesteps != [*range(len(timesteps))]:
        gap = next(i for i, t in enumerate(timesteps) if i != t)
        found = f"no frame of timestep {gap}, though timesteps reach {timesteps[-1]}"
        raise InputError(folder, "timestep_index", "timesteps numbered from 0 without a gap", found)
    first: dict[int, FrameEntry] = {}
    for entry in entries:
        other = first.setdefault(entry.timestep, entry)
        one, two = (os.path.abspath(e.parameters) for e in (entry, other))
        if (one, entry.sequence_folder) != (two, other.sequence_folder):
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
    """Descriptions of held-out data in training, one sentence each; empty if there is none.

    Looks for image files or contents in two splits, self-reenactment timesteps among the training timesteps, and
    novel-view cameras among the training cameras. Contents are read at each call, but only for images with the same
    file size as one of another split.
    """
    parts = {split: [images[key] for key in keys] for split, keys in splits.items()}
    contents = digests_of_same_size(parts, progress=progress)
    leaks = []
    for one, other in combinations(splits, 2):
        names = f"{one} and {other}"
        shared = sorted({images[key] for key in splits[one]} & {images[key] for key in splits[other]})
        if shared:
            leaks.append(
                f"{len(shared)} image files are in both {names}, such as {'/'.join(shared[0].parts[-3:])}"
            )
            continue
        by_content = {contents[images[key]]: key for key in splits[one] if images[key] in contents}
        equal = [key for key in splits[other] if contents.get(images[key]) in by_content]
        if equal:
            first = by_content[contents[images[equal[0]]]]
            leaks.append(
                f"{counted(len(equal), 'image')} of the same content in {names}, such as {first} and {equal[0]}"
            )
    train = splits.get("train", ())
    timesteps = sorted({k.timestep for k in train} & {k.timestep for k in splits.get("self_reenactment", ())})
    if timesteps:
        leaks.append(f"{len(timesteps)} self-reenactment timesteps are trained on, such as {timesteps[0]}")
    cameras = sorted({k.camera for k in train} & {k.camera for k in splits.get("novel_view", ())})
    if cameras:
        leaks.append(f"novel-view cameras are trained on: {', '.join(cameras)}")
    return leaks


def check_leaks(folder: Path, leaks: list[str], policy: LeakPolicy) -> list[str]:
    """Raise `InputError` for leaks found by `find_leaks`, or return them if the policy is ``"record"``."""
    if leaks and policy == "error":
        remedy = 'Fix the split, or read with leaks="record" to have this noted in every result.'
        raise InputError(folder, "splits", "splits that share nothing", "; ".join(leaks), remedy)
    return leaks


def sequence_names(entries: Iterable[FrameEntry], declared: Mapping[str, str]) -> dict[str, str]:
    """Sequence name by sequence folder: the declared one, else the one in the folder's name. Folders whose names give
    the same sequence keep their full names."""
    folders = sorted({entry.sequence_folder for entry in entries})
    names = {folder: declared.get(folder) or parse_sequence_folder(folder)[1] for folder in folders}
    taken = [*names.values()]
    return {folder: name if taken.count(name) == 1 else folder for folder, name in names.items()}


def check_disjoint(file: Path, splits: Mapping[str, Sequence[FrameKey]]) -> None:
    """Raise `InputError` for duplicate keys within a split or between splits."""
    for name, keys in splits.items():
        if len(set(keys)) != len(keys):
            twice, count = Counter(keys).most_common(1)[0]
            raise InputError(file, name, "every frame once", f"{twice} {count} times")
    for one, other in combinations(splits, 2):
        shared = sorted(set(splits[one]) & set(splits[other]))
        if shared:
            found = f"{len(shared)} frames in both, such as {shared[0]}"
            raise InputError(file, f"{one} and {other}", "splits that share no frame", found)


def split_by_holding_out(
    file: Path, keys: Iterable[FrameKey], sequences: Sequence[str], cameras: Sequence[str]
) -> dict[str, tuple[FrameKey, ...]]:
    """Split frames by the held-out sequences and cameras.

    All frames of the held-out sequences are self-reenactment, the held-out cameras' other frames are novel
    view, and the rest is training.

    ``sequences``: Full names or unique prefixes.
    """
    keys = sorted(set(keys))
    available = sorted({key.sequence for key in keys})
    held_out = {_match(file, wanted, available) for wanted in sequences}
    unknown = sorted(set(cameras) - {key.camera for key in keys})
    if unknown:
        known = ", ".join(sorted({key.camera for key in keys}))
        raise InputError(file, "held_out_cameras", f"ids out of {known}", ", ".join(unknown))
    test = tuple(key for key in keys if key.sequence in held_out)
    others = [key for key in keys if key.sequence not in held_out]
    return {
        "train": tuple(key for key in others if key.camera not in cameras),
        "novel_view": tuple(key for key in others if key.camera in cameras),
        "self_reenactment": test,
    }


def _match(file: Path, wanted: str, available: Sequence[str]) -> str:
    matches = [name for name in available if name == wanted] or [n for n in available if n.startswith(wanted)]
    if len(matches) != 1:
        found = f"{wanted!r}, which fits {', '.join(matches) or 'none'}"
        raise InputError(file, "held_out_sequences", f"one sequence out of {', '.join(available)}", found)
    return matches[0]


def require_full_grid(clip: CaptureClip, source: str | Path = "") -> None:
    """Check that every camera has a frame at every timestep; excluded frames count as existing. ``source``: The capture
    that the clip was read from, for the message."""
    timesteps = sorted({(key.sequence, key.timestep) for key in clip.files})
    wanted = (
        FrameKey(clip.subject, sequence, timestep, camera)
        for sequence, timestep in timesteps
        for camera in clip.cameras
    )
    missing = [key for key in wanted if key not in clip.files]
    if missing:
        where = str(source) or f"clip of {clip.subject}"
        more = f", and {len(missing) - 1} more missing" if len(missing) > 1 else ""
        remedy = (
            "List the frame in a transforms JSON of the capture, or leave its timestep or camera out of all."
        )
        found = f"no such frame{more}"
        expected = "a frame of every camera at every timestep"
        raise InputError(where, f"frame {missing[0]}", expected, found, remedy)
