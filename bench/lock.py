"""One process at a time in a folder: two that write the same frames and rows would mix their results."""

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

from .errors import InputError

LOCK_FILE = "run.lock"


@contextmanager
def locked(folder: Path, name: str = LOCK_FILE) -> Iterator[None]:
    """Keep other processes out of ``folder`` while the block runs; the file ``name`` in it tells the owner.

    The lock is the system's (``flock``), so that it ends with its process however that ends: a file left by a killed
    one keeps nobody out.

    Raises
    ------
    InputError : another process works in the folder; says which, where and since when.
    """
    path = folder / name
    stream = _acquire(path)
    try:
        owner = {"process": os.getpid(), "host": platform.node(), "since": _now()}
        stream.seek(0)
        stream.truncate()
        stream.write(json.dumps(owner) + "\n")
        stream.flush()
        yield
    finally:
        path.unlink(missing_ok=True)  # while still locked: whoever waits sees that the file has gone
        stream.close()


def _acquire(path: Path) -> IO[str]:
    while True:
        stream = path.open("a+", encoding="utf-8")
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            stream.seek(0)
            owner = _described(stream.read())
            stream.close()
            if error.errno not in (errno.EACCES, errno.EAGAIN):
                raise
            remedy = "Wait for it to end, or choose another folder."
            raise InputError(path, "", "a folder that no other process works in", owner, remedy) from None
        if _is_still(path, stream):
            return stream
        stream.close()  # the owner before us removed the file between our opening and locking it


def _is_still(path: Path, stream: IO[str]) -> bool:
    """Whether the open file is the one that lies at ``path`` now."""
    try:
        return os.path.samestat(path.stat(), os.fstat(stream.fileno()))
    except FileNotFoundError:
        return False


def _described(text: str) -> str:
    """The owner in words; the file may be half written, or not ours."""
    try:
        owner = json.loads(text)
        return f"process {int(owner['process'])} on {owner['host']}, since {owner['since']}"
    except (ValueError, KeyError, TypeError):
        return "another process, which does not tell its number"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
