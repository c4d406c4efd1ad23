"""Reads untrusted ZIP files: the declared sizes are checked before anything is unpacked."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import InputError
from .files import open_regular, reading


@contextmanager
def open_archive(
    path: Path, expected: str, *, members: int, spare_bytes: int, per_byte: int
) -> Iterator[zipfile.ZipFile]:
    """Open a ZIP file; while the block runs, errors of unpacking it become `InputError`.

    zipfile unpacks no more of a member than the directory declares, so these checks bound the unpacked size.

    Parameters
    ----------
    expected : str
        Kind of file, named in errors.
    members : int
        Maximum number of members. Names must be unique, and members stored or deflated.
    spare_bytes, per_byte : int
        All members together unpack to at most ``spare_bytes + per_byte * size of the file``.
    """
    with reading(path, expected), open_regular(path, expected) as stream, zipfile.ZipFile(stream) as archive:
        entries = archive.infolist()
        if len(entries) > members or len({entry.filename for entry in entries}) < len(entries):
            raise InputError(path, "", f"at most {members} members, each name once", f"{len(entries)}")
        for entry in entries:
            # Other compression methods need unbounded memory.
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                found = f"compression {entry.compress_type}"
                raise InputError(path, entry.filename, "stored or deflated", found)
        limit = spare_bytes + per_byte * os.fstat(stream.fileno()).st_size
        unpacked = sum(entry.file_size for entry in entries)
        if unpacked > limit:
            raise InputError(path, "", f"members of at most {limit} bytes", f"{unpacked} bytes")
        yield archive
