"""Locks folders, since two processes that write the same frames and rows would mix their
results."""

from __future__ import annotations

import fcntl
import json
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import InputError
from .files import TEMPORARY, removed_if_empty

LOCK_FILE = "run.lock"


@contextmanager
def locked(folder: Path, *, beside: bool = False) -> Iterator[None]:
    """Lock ``folder`` within the block; the lock file names the owner.

    The lock ends with its process: the file of a killed process locks nobody out. While locked, temporary files of
    killed processes are removed. ``beside`` creates the lock file beside the folder, for folders that must be empty. A new folder
    without content is removed.
    """
    path = folder.resolve().parent / f".{folder.resolve().name}.lock" if beside else folder / LOCK_FILE
    with removed_if_empty(folder):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = _acquire(path)
        try:
            now = datetime.now(UTC).isoformat(timespec="seconds")
            path.write_text(
                json.dumps({"process": os.getpid(), "host": platform.node(), "since": now}) + "\n"
            )
            remove_temporaries(folder)
            yield
        finally:
            path.unlink(missing_ok=True)  # while still locked: who opened it before sees that it is gone
            lock.release()


def is_locked(folder: Path) -> bool:
    """Whether a process holds the lock of ``folder``, which may be read-only here."""
    try:
        with open(folder / LOCK_FILE) as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def remove_temporaries(folder: Path) -> None:
    """Remove unfinished files of killed processes in a folder and its subfolders, except those that others lock."""
    for root, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not is_locked(Path(root, name))]
        for name in names:
            if name.startswith(TEMPORARY):
                Path(root, name).unlink(missing_ok=True)


def _acquire(path: Path) -> FileLock:
    lock = FileLock(path, timeout=0, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        remedy = "Wait for it to end, or choose another folder."
        raise InputError(path, "", "a folder that no other process works in", _owner(path), remedy) from None
    return lock


def _owner(path: Path) -> str:
    """Description of the owner; the file may be incomplete or from another program."""
    try:
        owner = json.loads(path.read_text())
        return f"process {int(owner['process'])} on {owner['host']}, since {owner['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process of unknown number"
