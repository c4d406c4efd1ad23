"""Digests of file contents, stored in the user's cache and valid while the files are unchanged.

JSON, npz and text are digested in a form that does not depend on the program that wrote the same content: white space, order
of keys and arrays, compression, 1 for 1.0, and the spelling of paths and camera ids. For files of headbench it is the file's
own bytes. Other files, such as images, are digested as they are.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...bench.contracts import Progress, no_progress
from ...bench.errors import UnavailableError
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
    """Hex SHA-256 of a file's content. Raises `InputError` for damaged JSON and npz."""
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

    Parameters
    ----------
    cached_for : Path | None
        The capture that the files belong to. Digests of files with an unchanged `Stamp` are taken
        from the user's cache (``digests`` of `cache_folder`, never the capture itself), and new
        digests are stored there. None reads every byte.
    """
    paths = sorted(set(files))
    place = _place(cached_for) if cached_for else None
    known = _read_cache(place) if place else {}
    stamps = {path: Stamp.of(path) for path in paths}
    result = {path: known[_name(stamps[path])] for path in paths if _name(stamps[path]) in known}
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
    """Digests as by `content_digests` of the files that have the same size as one of another split.

    Paths that name no file are left out.
    """
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
