"""Digests of file contents, stored in the user's cache and valid while the files are unchanged."""

from __future__ import annotations

import json
import logging
import os
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from ...bench.contracts import Progress, no_progress
from ...bench.errors import UnavailableError
from ...bench.io.files import cache_folder, digest, digest_file, write_json

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


def content_digests(
    files: Iterable[Path], *, cached_for: Path | None = None, progress: Progress = no_progress
) -> dict[Path, str]:
    """Hex SHA-256 of each file's content.

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
        for done, (path, value) in enumerate(zip(missing, pool.map(digest_file, missing)), start=1):
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
        return cache_folder() / "digests" / f"{digest(os.path.abspath(folder))[:32]}.json"
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
