"""Atomic writing of files, validation of file names, fingerprints of content."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import stat
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import HeadbenchError, InputError, UnavailableError

MAX_NAME_BYTES = 120
"""Maximum length of a subject, sequence or camera name; file names combine several and are limited to 255 bytes."""

FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""System errors that would affect every other file, too."""

ROOM_BYTES = 64 * 2**10
"""Less free space than this counts as a full disk."""

TEMPORARY = ".tmp-headbench-"
"""Prefix of temporary files, by which those of killed processes are found and removed."""

_UMASK = os.umask(0o077)
os.umask(_UMASK)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path``; rename it to ``path`` if the block ends without an error.

    The content is on disk before the rename, so that there are no partial files after a kill or a power failure, and a
    disk that is full raises. The temporary name keeps the suffix, since many writers choose their format by it. A link at
    ``path`` is replaced, not followed.
    """
    _check_target(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=TEMPORARY, suffix=path.suffix)
    except OSError as error:
        error.filename = str(path)
        raise
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        _flush(temporary)
        # mkstemp and some writers create private files; results should be readable by anyone who can read the folder.
        if os.stat(temporary).st_nlink == 1:  # not a hard link to another file
            os.chmod(temporary, 0o666 & ~_UMASK)
        os.replace(temporary, path)
    except OSError as error:
        # The system reports a full disk without a name or with the temporary one.
        if error.errno is not None and error.filename in (None, name):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Wait until a file is on disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically (UTF-8)."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file of bytes atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Write `json_text` of a value atomically."""
    write_text(path, json_text(value))


def json_text(value: Any) -> str:
    """Content of a JSON file, keys in the order given, numpy scalars and arrays as numbers and lists.

    Raises `ValueError` for a non-finite number, which JSON cannot represent.
    """
    return json.dumps(value, indent=1, default=to_jsonable, allow_nan=False) + "\n"


def check_writable(path: Path, option: str) -> None:
    """Make sure, before long work, that a file can be written at ``path``, in a folder that exists."""
    marks = {pattern.rpartition("/")[2] for patterns in KINDS.values() for pattern in patterns}
    if path.is_symlink() or (path.exists() and path.name in marks | RESULTS):
        found = "a link" if path.is_symlink() else "a file of a run or a capture"
        raise InputError(path, option, "a file that is new or was written so", found, "Nothing was written.")
    with _writable(path, option, "a file"):
        _check_target(path)
        if not path.parent.is_dir():
            expected = "a file in an existing folder"
            raise InputError(path, option, expected, f"no folder {path.parent}", "Make that folder first.")
        _try_to_write(path.parent)


def check_output_folder(folder: Path) -> None:
    """Make sure, before any work, that the folder of ``--out`` can be made and written.

    A folder that does not exist yet is not left behind.
    """
    with _writable(folder, "--out", "a folder"), removed_if_empty(folder):
        _try_to_write(folder)


KINDS: Mapping[str, tuple[str, ...]] = {
    "a capture": (
        *("transforms.json", "transforms_train.json", "transforms_val.json", "transforms_test.json"),
        *("canonical_flame_param.npz", "fg_masks", "flame_params.json", "flame/exp"),
    ),
    "captures": ("*/transforms.json", "*/transforms_train.json", "*/flame_params.json"),
    "a synthetic capture": ("synthesis.json",),
    "a COLMAP dataset": ("sparse", "cameras.bin", "cameras.txt"),
    "a recording": (
        *("camera_params", "recording", "sequence_*_part-*", "calibration/camera_params.json"),
        *("*/calibration/camera_params.json", "*/*/calibration/camera_params.json"),
    ),
    "a run": ("run.json",),
    "a cell of a run": ("cell.json",),
    "an avatar": ("avatar.json", "subject.npz"),
}
"""Patterns of files and folders that identify a kind of folder."""
RESULTS = {"rows.parquet", "headbench.json", "cell.json", "head_model.npz", "avatar.json"}
"""Files with results or captures, which are never the target of an option."""


def check_kind(folder: Path, *kinds: str) -> None:
    """Check, before anything is written, that the folder of ``--out`` has no content of another kind.

    ``kinds`` (of `KINDS`) are those that the command writes and may therefore continue. Raises
    `InputError` with the file by which another kind was recognised.
    """
    for kind, patterns in KINDS.items():
        marks = (path for pattern in patterns for path in folder.glob(pattern)) if kind not in kinds else ()
        for mark in marks:
            expected = " or ".join(["a new folder", *(f"one that holds {kind}" for kind in kinds)])
            found = f"{kind} ({mark.relative_to(folder)})"
            raise InputError(folder, "--out", expected, found, "Nothing was written. Name another folder.")


@contextmanager
def removed_if_empty(folder: Path) -> Iterator[None]:
    """At the end of the block, remove the folder and its parents if the block created them and they are empty."""
    created = list(takewhile(lambda path: not path.exists(), (folder, *folder.parents)))
    try:
        yield
    finally:
        for path in created:
            with suppress(OSError):
                path.rmdir()


def check_room(folder: Path) -> None:
    """Write a small file in a folder. Raises `OSError` with the folder's name if the disk is full."""
    try:
        with tempfile.TemporaryFile(dir=folder, prefix=TEMPORARY) as stream:
            stream.write(bytes(ROOM_BYTES))
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        error.filename = str(folder)
        raise


@contextmanager
def _writable(path: Path, option: str, what: str) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        found = getattr(error, "strerror", None) or str(error)
        if isinstance(error, FileExistsError | IsADirectoryError) and (path.is_file() or path.is_dir()):
            found = "a file" if path.is_file() else "a folder"
        raise InputError(path, option, f"{what} that can be written", found) from error


def _try_to_write(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    check_room(folder)


def _check_target(path: Path) -> None:
    """Refuse targets that a rename must not replace, such as devices."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        return  # a link to itself, which is replaced like any link
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise FileExistsError(errno.EEXIST, "Not a regular file", str(path))


@contextmanager
def reading(path: str | os.PathLike[str], expected: str, key: str = "", remedy: str = "") -> Iterator[None]:
    """Convert any exception of a library that reads a file into an `InputError` with its message.

    Errors of headbench and a full disk are not converted. The block should only call the library, since other
    errors in it would be reported as errors of the file.

    Parameters
    ----------
    path : str | os.PathLike[str]
        The file that is read; ``key`` is the entry in it.
    expected : str
        Kind of file, such as "a NumPy archive".
    remedy : str
        Remedy for a file that cannot be read.
    """
    try:
        yield
    except HeadbenchError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in FULL_DISK:
            raise
        raise InputError(path, key, expected, _words(error), remedy) from error


def _words(error: Exception) -> str:
    """The message of an exception as one line."""
    if isinstance(error, FileNotFoundError):
        return "no such file"
    if isinstance(error, MemoryError):
        return "too little memory to read it"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    lines = str(error).strip().splitlines()
    return f"unreadable content ({': '.join([type(error).__name__, *lines[:1]])})"


@contextmanager
def open_regular(path: Path, expected: str) -> Iterator[BinaryIO]:
    """Open a file for reading bytes.

    Pipes and devices, which might never end, are refused immediately.
    """
    with reading(path, expected):
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    kind = os.fstat(handle).st_mode
    if not stat.S_ISREG(kind):
        os.close(handle)
        raise InputError(path, "", expected, "a folder" if stat.S_ISDIR(kind) else "a pipe or a device")
    with os.fdopen(handle, "rb") as stream:
        yield stream


def read_bytes(path: Path, expected: str) -> bytes:
    """A file's content."""
    with open_regular(path, expected) as stream, reading(path, expected):
        return stream.read()


def check_name(name: str, file: str | os.PathLike[str], key: str) -> str:
    """Return an untrusted name if it is valid as one part of a path, since folders are named after it."""
    unfit = any(character in "/\\:" or not character.isprintable() for character in name)
    if not name or name.startswith(".") or unfit or len(name.encode(errors="replace")) > MAX_NAME_BYTES:
        expected = f"a name without slashes, colons and leading dots, of 1 to {MAX_NAME_BYTES} bytes"
        raise InputError(file, key, expected, repr(name[:60]))
    return name


def with_slashes(path: str) -> str:
    """A relative path from a file, with the backslashes of Windows programs converted to slashes."""
    return path.replace("\\", "/")


def is_system_file(name: str) -> bool:
    """Whether a file name is one that operating systems create, such as ``.DS_Store`` or ``._a.png``."""
    return name.startswith("._") or name.lower() in (".ds_store", "thumbs.db", "desktop.ini", "__macosx")


def entries(folder: Path, pattern: str = "*") -> list[Path]:
    """Entries of a folder that match a pattern, sorted, without hidden files and files of operating systems.

    For reading; empty if the folder does not exist.
    """
    return [path for path in user_files(folder, pattern) if not path.name.startswith(".")]


def natural_order(name: str) -> list[str | int]:
    """Key that sorts names by their numbers: 2 before 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def user_files(folder: Path, pattern: str = "*") -> list[Path]:
    """As `entries`, including hidden files except those of interrupted writes: existing content that a command must
    keep separate."""
    files = sorted(path for path in folder.glob(pattern) if not is_system_file(path.name))
    return [path for path in files if not path.name.startswith(TEMPORARY)]


def expand_home(text: str, source: str) -> str:
    """Replace ``~`` or ``~user`` at the start of a path by the home folder, as a shell does; leave other text alone."""
    if not re.match(r"~($|[\w.-]*/)", text):
        return text
    path = os.path.expanduser(text)
    if path.startswith("~"):
        found = f"none for {text.partition('/')[0]}"
        raise InputError(source, text, "a path in a home folder that is known", found)
    return path


def to_jsonable(value: Any) -> Any:
    """Convert a dataclass, array, path or set to values that JSON supports; for
    ``json.dumps(default=to_jsonable)``."""
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


def cache_folder() -> Path:
    """The user's cache: ``$XDG_CACHE_HOME/headbench``, by default ``~/.cache/headbench``.

    Raises `UnavailableError` if the user has no home folder.
    """
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "headbench"
    except RuntimeError as error:
        remedy = "Set HOME, or XDG_CACHE_HOME to a folder for caches."
        raise UnavailableError(
            "The user's cache has no place: the user has no home folder.", remedy
        ) from error


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
            state.update(json.dumps(value, sort_keys=True, default=to_jsonable).encode())
        state.update(b"\0")
    return state.hexdigest()


def digest_file(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
