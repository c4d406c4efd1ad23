"""Arrays of npz and npy files from outside: sizes are checked before memory is taken, numbers before they are used."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import IO

import numpy as np

from ..errors import InputError
from .files import open_regular, reading

MOST_BYTES, MOST_PER_BYTE = 2**28, 20
"""All arrays of a file may take 256 MiB, and 20 bytes for each byte of the file: ten times any head model, which
compresses well, and tracked parameters of any length, which do not."""

MAX_MEMBERS, MAX_DIMENSIONS = 1000, 8
MAX_MAGNITUDE = 1e4
"""Most that a number of a head model or its tracking may be: metres, radians, coefficients."""

_DEFLATE_RATIO = 1040  # bytes out of one that went in are 1032 at most
_KINDS = "biufU"
_LARGEST_ITEM = 8


@dataclass(frozen=True)
class Member:
    """What an array has to be.

    Attributes
    ----------
    kinds : letters of numpy's kinds of types; "U" is text.
    shape : of each axis its size, a name for one size wherever it stands, or None for any; None for any shape.
    most : largest magnitude. Floating-point numbers have to be finite without it, too.
    dtype : the very type, "" for any of ``kinds``.
    optional : the file may lack it.
    """

    kinds: str = "f"
    shape: tuple[int | str | None, ...] | None = None
    most: float | None = None
    dtype: str = ""
    optional: bool = False


TEXT = Member("U", ())
"""One text."""


def read_arrays(
    path: Path, members: Mapping[str, Member], sizes: Mapping[str, int] | None = None
) -> dict[str, np.ndarray]:
    """Read an npz whose members have to be as described; others are returned unchecked.

    ``sizes`` gives sizes of axes by the names that stand in ``members``. Raises `InputError` where `read_npz` does,
    and for the first member that is missing or not as described.
    """
    content = read_npz(path)
    check_arrays(path, content, members, sizes)
    return content


def check_arrays(
    path: str | PathLike[str],
    content: Mapping[str, np.ndarray],
    members: Mapping[str, Member],
    sizes: Mapping[str, int] | None = None,
) -> dict[str, int]:
    """Check arrays by name; return the sizes of the named axes. Raises `InputError` as `read_arrays` does."""
    known = dict(sizes or {})
    for name, member in members.items():
        if name in content:
            _check(path, name, content[name], member, known)
        elif not member.optional:
            found = f"only {', '.join(sorted(content))}"[:400]
            raise InputError(path, name, "an array of that name", found)
    return known


def check_numbers(
    path: str | PathLike[str], name: str, values: np.ndarray, most: float | None = None
) -> None:
    """Raise `InputError` for a number that is not finite, or larger than ``most`` in magnitude."""
    if values.dtype.kind == "f":
        broken = int(values.size - np.count_nonzero(np.isfinite(values)))
        if broken:
            raise InputError(path, name, "finite numbers", f"{broken} that are NaN or infinite")
    if most is not None and values.size:
        largest = max(float(values.max()), -float(values.min()))
        if largest > most:
            raise InputError(path, name, f"numbers from {-most:g} to {most:g}", f"one of size {largest:g}")


def _check(
    path: str | PathLike[str], name: str, values: np.ndarray, member: Member, sizes: dict[str, int]
) -> None:
    if values.dtype.kind not in member.kinds or (member.dtype and values.dtype != np.dtype(member.dtype)):
        kinds = {"f": "floating-point numbers", "iu": "integers", "fiu": "numbers", "U": "text"}
        expected = member.dtype or kinds.get(member.kinds, f"numpy's kinds {member.kinds}")
        raise InputError(path, name, expected, f"dtype {values.dtype}")
    if member.shape is not None:
        wanted = [sizes.get(size) if isinstance(size, str) else size for size in member.shape]
        fits = len(wanted) == values.ndim and all(w in (None, n) for w, n in zip(wanted, values.shape))
        if fits:
            for size, found in zip(member.shape, values.shape):
                fits = fits and (not isinstance(size, str) or sizes.setdefault(size, found) == found)
        if not fits:
            named = [str(w if w is not None else s or "any") for w, s in zip(wanted, member.shape)]
            comma = "," * (len(named) == 1)
            raise InputError(path, name, f"shape ({', '.join(named)}{comma})", f"shape {values.shape}")
    if values.dtype.kind in "fiu":
        check_numbers(path, name, values, member.most)


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read every member of an npz: numbers, truth values and text in the machine's byte order.

    Sizes are taken from the headers and compared with each other, with the file's and with `MOST_BYTES` before
    anything is unpacked; nothing is ever unpickled. Raises `InputError` for a file that is missing, damaged, too
    large, or anything else than an npz of such arrays.
    """
    expected = "an npz file of plain arrays"
    with reading(path, expected), open_regular(path, expected) as stream, zipfile.ZipFile(stream) as archive:
        return _members(path, archive, stream.seek(0, io.SEEK_END))


def read_npy(path: Path) -> np.ndarray:
    """Read the array of an npy file, as `read_npz` reads its members; raises `InputError` as it does."""
    expected = "an npy file of a plain array"
    with reading(path, expected), open_regular(path, expected) as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        return _array(path, "", stream, size)


def _members(path: Path, archive: zipfile.ZipFile, size: int) -> dict[str, np.ndarray]:
    limit = MOST_BYTES + MOST_PER_BYTE * size
    unpacked = 0
    entries = archive.infolist()
    if len(entries) > MAX_MEMBERS:
        raise InputError(path, "", f"at most {MAX_MEMBERS} arrays", f"{len(entries)}")
    for entry in entries:
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError(path, entry.filename[:80], "a stored or deflated member", "another compression")
        ratio = 1 if entry.compress_type == zipfile.ZIP_STORED else _DEFLATE_RATIO
        unpacked += entry.file_size
        if entry.compress_size > size or entry.file_size > ratio * entry.compress_size:
            found = f"{entry.file_size} bytes in {entry.compress_size} of {size}"
            raise InputError(path, entry.filename[:80], "a member that fits into the file", found)
        if unpacked > limit:
            raise InputError(path, "", f"at most {limit} bytes of arrays", f"{unpacked} bytes or more")
    content: dict[str, np.ndarray] = {}
    for entry in entries:
        name = entry.filename.removesuffix(".npy")
        if name == entry.filename or name in content:
            raise InputError(
                path, entry.filename[:80], "members .npy, each name once", "another or a second one"
            )
        with archive.open(entry) as stream:
            content[name] = _array(path, name, stream, entry.file_size)
    return content


def _array(path: Path, name: str, stream: IO[bytes], size: int) -> np.ndarray:
    """One array in npy format, ``size`` bytes with its header."""
    counted = _Counted(stream)
    version = np.lib.format.read_magic(counted)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise InputError(path, name, "the npy format 1.0 or 2.0", f"{version[0]}.{version[1]}")
    shape, fortran, dtype = readers[version](counted)
    plain = dtype.kind in _KINDS and dtype.subdtype is None and dtype.names is None
    if not plain or (dtype.kind != "U" and dtype.itemsize > _LARGEST_ITEM):
        raise InputError(path, name, "numbers of at most 8 bytes, or text", f"dtype {dtype}"[:100])
    wanted = math.prod(shape) * dtype.itemsize if len(shape) <= MAX_DIMENSIONS else -1
    if wanted != size - counted.read_bytes or any(side < 0 or side > 2**48 for side in shape):
        found = f"{size - counted.read_bytes} bytes"
        raise InputError(path, name, f"the bytes of {dtype} of shape {shape}"[:200], found)
    raw = stream.read(wanted)
    if len(raw) != wanted or stream.read(1):
        raise InputError(path, name, f"{wanted} bytes", "another number")
    values = np.frombuffer(raw, np.uint8 if dtype.kind == "b" else dtype)
    if dtype.kind == "b":
        values = values != 0
    if dtype.kind == "U":
        _check_text(path, name, values, dtype)
    values = values.reshape(shape, order="F" if fortran else "C")
    return np.array(values, dtype=values.dtype.newbyteorder("="), order="K")


def _check_text(path: Path, name: str, values: np.ndarray, dtype: np.dtype) -> None:
    """Numbers in place of characters that are none make Python raise wherever the text is used."""
    if not dtype.itemsize:
        return
    codes = values.view(np.dtype(np.uint32).newbyteorder(dtype.byteorder))
    if codes.size and (int(codes.max()) > 0x10FFFF or bool(((codes >= 0xD800) & (codes < 0xE000)).any())):
        raise InputError(path, name, "text", "numbers that are no characters")


class _Counted:
    """A stream that counts what was read of it."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self.read_bytes = stream, 0

    def read(self, size: int = -1, /) -> bytes:
        """Read up to ``size`` bytes."""
        content = self._stream.read(size)
        self.read_bytes += len(content)
        return content
