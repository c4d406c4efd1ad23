"""Locks folders, since two processes that write the same frames and rows would mix their
results."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from ..errors import InputError
from .files import (
    check_inside,
    flush_renames,
    no_link,
    output_inside,
    remove_dead_temporaries,
    removed_if_empty,
)

LOCK_FILE = "run.lock"
_MOST = 1000  # maximum characters of a lock file


@contextmanager
def locked(folder: Path, *, beside: bool = False) -> Iterator[None]:
    """Lock ``folder`` within the block; the lock file names the owner.

    The lock is a system lock (``flock``), which ends with its process: the file of a killed process locks
    nobody out. While locked, temporary files of dead processes are removed, and nothing is written through links
    out of the folder. ``beside`` creates the lock file beside the folder, for folders that must be empty.
    A new folder without content is removed.

    Raises
    ------
    InputError
        Another process works in the folder (the message gives process, host and time), the folder
        cannot be created, or its lock file is a link.
    """
    path = folder.resolve().parent / f".{folder.resolve().name}.lock" if beside else folder / LOCK_FILE
    check_inside(folder)
    with removed_if_empty(folder):
        stream = _acquire(path)
        try:
            owner = {"process": os.getpid(), "host": platform.node(), "since": _now()}
            stream.seek(0)
            stream.truncate()
            stream.write(json.dumps(owner) + "\n")
            stream.flush()
            remove_dead_temporaries(folder)
            with output_inside(folder):
                yield
        finally:
            try:
                flush_renames()
            finally:
                path.unlink(
                    missing_ok=True
                )  # while still locked, so that waiting processes see that the file is gone
                stream.close()


def is_locked(folder: Path) -> bool:
    """Whether a process of this machine holds the lock of ``folder``."""
    try:
        with open(folder / LOCK_FILE, encoding="utf-8", opener=no_link) as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _acquire(path: Path) -> IO[str]:
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        stream = open(path, "a+", encoding="utf-8", opener=no_link)  # noqa: SIM115
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            stream.seek(0)
            owner = _described(stream.read(_MOST))
            stream.close()
            if error.errno not in (errno.EACCES, errno.EAGAIN):
                raise
            remedy = "Wait for it to end, or choose another folder."
            raise InputError(path, "", "a folder that no other process works in", owner, remedy) from None
        if _is_still(path, stream):
            return stream
        stream.close()  # the previous owner removed the file before it was locked here


def _is_still(path: Path, stream: IO[str]) -> bool:
    """Whether the open file is still the one at ``path``."""
    try:
        return os.path.samestat(path.stat(), os.fstat(stream.fileno()))
    except FileNotFoundError:
        return False


def _described(text: str) -> str:
    """Description of the owner; the file may be incomplete or from another program."""
    try:
        owner = json.loads(text)
        return f"process {int(owner['process'])} on {owner['host']}, since {owner['since']}"
    except (ValueError, KeyError, TypeError):
        return "another process of unknown number"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
