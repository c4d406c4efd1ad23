"""Tell a whole mp4 file from a truncated one by its boxes, without decoding anything.

A file is a sequence of boxes, each with its size in front (ISO/IEC 14496-12, 4.2). A file cut short either
lacks its index (``moov``) or has a box that reaches beyond the end.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import BinaryIO

from ...bench.errors import InputError

_TRUNCATED = "Fetch the file again."


def check_boxes(path: Path) -> None:
    """Raise `InputError` for a file that is missing, no mp4, or cut short. Reads a few bytes per box."""
    try:
        with path.open("rb") as stream:
            kinds = _walk(path, stream)
    except OSError as error:
        raise InputError(path, "", "an mp4 video", error.strerror or str(error)) from error
    for kind in ("moov", "mdat"):
        if kind not in kinds:
            found = f"boxes {', '.join(kinds) or 'none'}"
            raise InputError(path, kind, "a whole mp4 video, with index and frames", found, _TRUNCATED)


def _walk(path: Path, stream: BinaryIO) -> list[str]:
    """Kinds of the top-level boxes."""
    end = os.fstat(stream.fileno()).st_size
    kinds: list[str] = []
    position = 0
    while position < end:
        stream.seek(position)
        header = stream.read(16)
        if len(header) < 8:
            raise InputError(path, "", "a whole mp4 box", f"{len(header)} bytes at the end", _TRUNCATED)
        size, kind = struct.unpack(">I4s", header[:8])
        if size == 1 and len(header) == 16:
            (size,) = struct.unpack(">Q", header[8:])
        elif size == 0:  # the last box, up to the end of the file
            size = end - position
        name = kind.decode("latin-1")
        if not kinds and not name.isprintable():
            raise InputError(path, "", "an mp4 video", f"a file that starts with {header[:8]!r}")
        if size < 8 or position + size > end:
            expected = f"a box {name!r} of {size} bytes" if size >= 8 else "boxes of 8 bytes or more"
            found = f"{end - position} bytes left" if size >= 8 else f"one of {size}"
            raise InputError(path, name, expected, found, _TRUNCATED)
        kinds.append(name)
        position += size
    return kinds
