"""Files written whole or not at all, JSON read with care, names fit for files, fingerprints of content."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError

MAX_NAME_BYTES = 120
"""Longest name of a subject, a sequence or a camera; a file name made of several has to fit into 255 bytes."""

WRITE_FAULTS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""What the system says of a disk that takes no more; a fault of the place, not of the program."""


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Give a temporary name beside ``path``; rename it to ``path`` if the block ends without an error.

    The temporary name keeps the suffix, since many writers choose their format by it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes private files, and so do some writers; results are to be read by whoever may read the folder.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)
        os.replace(temporary, path)
    except OSError as error:
        # A full disk says so in the middle of writing, where the system no longer tells of which file.
        if error.errno is not None and error.filename in (None, name):
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically (UTF-8)."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, keys in the order given, numpy scalars and arrays as numbers and lists."""
    write_text(path, json.dumps(value, indent=1, default=plain) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file whose top level is an object.

    Raises `InputError` for a file that is missing, cannot be read, does not parse (nesting without end
    included) or holds something else.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(path, "", "a JSON file", "no such file") from error
    except OSError as error:
        raise InputError(path, "", "a readable JSON file", error.strerror or str(error)) from error
    except (ValueError, RecursionError) as error:
        raise InputError(path, "", "valid JSON", f"content that does not parse ({error})") from error
    if not isinstance(value, dict):
        raise InputError(path, "", "a JSON object", f"a {type(value).__name__}")
    return value


def check_name(name: str, file: str | os.PathLike[str], key: str) -> str:
    """Return a name if it can be one part of a path; it came from outside, and folders are named after it.

    Raises `InputError` for an empty name, one that starts with a dot, one longer than `MAX_NAME_BYTES`, and one
    with a slash, a backslash, a colon or a control character: such a name could lead out of the folder that it
    is put in.
    """
    unfit = any(character in "/\\:" or not character.isprintable() for character in name)
    if not name or name.startswith(".") or unfit or len(name.encode(errors="replace")) > MAX_NAME_BYTES:
        expected = f"a name without slashes, colons and leading dots, of 1 to {MAX_NAME_BYTES} bytes"
        raise InputError(file, key, expected, repr(name[:60]))
    return name


def plain(value: Any) -> Any:
    """Turn a dataclass, array, path or set into what JSON knows; for ``json.dumps(default=plain)``."""
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return value.as_posix()
    if isinstance(value, (set, frozenset)):
        return sorted(value)
    if isinstance(value, tuple):
        return list(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def digest(*values: Any) -> str:
    """Hex SHA-256 over arrays (dtype, shape, bytes), bytes, text and JSON-like values, in order."""
    state = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray):
            state.update(f"{value.dtype.str}{value.shape}".encode())
            state.update(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, bytes):
            state.update(value)
        else:
            state.update(json.dumps(value, sort_keys=True, default=plain).encode())
        state.update(b"\0")
    return state.hexdigest()


def digest_file(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
