"""Read dictionaries of numpy arrays in files of ``torch.save`` without executing anything in the file."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

from ..errors import InputError
from .archives import open_archive
from .unpickle import plain_content

EXPECTED = "a file of torch.save with a dictionary of numpy arrays"
REMEDY = "The file was not read. Save numpy arrays and numbers, as the tracker's own program does."
MAX_BYTES = 2**26
"""Maximum size of a pickle; a tracker's file has 0.01 MB."""
MAX_MEMBERS = 100
LEVELS = 2
"""Maximum nesting of dictionaries."""


def read_saved(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a dictionary of numpy arrays, possibly nested, from a file of ``torch.save``.

    The layout is the archive of PyTorch 1.6 and later. Tensors are refused, as are all objects other than NumPy arrays.

    Returns
    -------
    dict[str, Any]
        As `read_pickle`; nested dictionaries are plain ones with text keys.

    Raises
    ------
    InputError
        As `read_pickle`, and for a file above `MAX_BYTES` or in the layout before PyTorch 1.6. Nothing in the file
        is executed.
    """
    path = Path(path)
    with open_archive(path, EXPECTED, members=MAX_MEMBERS, spare_bytes=0, per_byte=1) as archive:
        entries = [entry for entry in archive.infolist() if entry.filename.endswith("/data.pkl")]
        if len(entries) != 1 or entries[0].file_size > MAX_BYTES:
            expected = f"one member data.pkl of at most {MAX_BYTES} bytes"
            raise InputError(path, "", expected, f"{[entry.file_size for entry in entries]} bytes")
        stream = archive.read(entries[0])
    return plain_content(path, stream, EXPECTED, REMEDY, LEVELS)
