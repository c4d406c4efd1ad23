"""Digests of file contents, remembered between runs by size and modification time."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ..bench.contracts import Progress, no_progress
from ..bench.files import digest_file, write_json

_log = logging.getLogger(__name__)
_THREADS = 4  # hashing releases the interpreter lock; more threads only help slow disks

CACHE_FILE = ".headbench-digests.json"


def content_digests(
    folder: Path, files: Iterable[Path], *, progress: Progress = no_progress
) -> dict[Path, str]:
    """Hex SHA-256 of each file's content.

    The first call reads every byte. Digests are kept in ``folder``/`CACHE_FILE` with each file's size and
    modification time, and a later call reads only the files that differ in either. A folder that cannot be
    written is read anew each time.
    """
    paths = sorted(set(files))
    names = {path: Path(os.path.relpath(path, folder)).as_posix() for path in paths}
    known = _read_cache(folder / CACHE_FILE)
    stamps = {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in paths}
    result: dict[Path, str] = {}
    for path in paths:
        size, modified, value = known.get(names[path], (-1, -1, ""))
        if (size, modified) == stamps[path]:
            result[path] = value
    missing = [path for path in paths if path not in result]
    with ThreadPoolExecutor(_THREADS) as pool:
        for done, (path, value) in enumerate(zip(missing, pool.map(digest_file, missing)), start=1):
            result[path] = value
            progress(done, len(missing), "reading file contents")
    if missing:
        _write_cache(folder / CACHE_FILE, {names[path]: (*stamps[path], result[path]) for path in paths})
    return result


def _read_cache(path: Path) -> dict[str, tuple[int, int, str]]:
    """Entries of the cache; none where it is missing or not as `_write_cache` left it."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return {
            str(name): (int(size), int(time), str(value)) for name, (size, time, value) in entries.items()
        }
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _write_cache(path: Path, entries: dict[str, tuple[int, int, str]]) -> None:
    try:
        write_json(path, entries)
    except OSError as error:
        _log.info("digests are not kept, %s cannot be written: %s", path, error)
