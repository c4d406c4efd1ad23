"""PLY files of one float32 vertex table, as read by splat viewers.

Formats read:

- PLY of splats. Written by ShenhanQian/GaussianAvatars 30cc4bde (`scene/gaussian_model.py`). Not checked on a file of the program.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.files import atomic_path, open_regular, read_bytes

SCALARS = {
    **dict.fromkeys(("char", "int8"), "<i1"),
    **dict.fromkeys(("uchar", "uint8"), "<u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
"""Types of properties; each has two names."""
BEGIN, END = re.compile(rb"ply\r?\n"), re.compile(rb"\nend_header\r?\n")
OPACITY, LARGEST_LOGIT = "opacity", 20.0  # its sigmoid is 1 in float32
_COUNT = re.compile(r"[0-9]{1,18}")
EXPECTED = "a PLY file"
HEADER_LIMIT = 65536  # bytes; files with a longer header are refused


def write_ply(path: Path, names: tuple[str, ...], table: FloatArray, comment: str = "") -> None:
    """Write an (N, len(names)) table as binary little-endian float32 vertices atomically.

    Comments are at the end of the header because some viewers count the lines before the properties.
    """
    if table.ndim != 2 or table.shape[1] != len(names):
        raise ValueError(f"table: expected (N, {len(names)}), found {table.shape}")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in names]
    header += [f"comment {comment}"] if comment else []
    header.append("end_header")
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(("\n".join(header) + "\n").encode("ascii"))
        stream.write(np.ascontiguousarray(table, dtype="<f4").tobytes())


def read_ply(path: Path, names: tuple[str, ...]) -> FloatArray:
    """Read columns of a binary little-endian vertex table by name, as (N, len(names)) float32.

    Other columns of any scalar type are ignored.
    """
    content = read_bytes(path, EXPECTED)
    count, columns, start = _header(path, content)
    missing = [name for name in names if name not in columns]
    if missing:
        raise InputError(path, missing[0], "a property of that name", f"{len(columns)} others")
    row = np.dtype(list(columns.items()))
    size = count * row.itemsize
    if len(content) - start != size:
        raise InputError(path, "vertex data", f"{size} bytes", f"{len(content) - start}")
    table = np.frombuffer(content, dtype=row, offset=start)
    chosen = np.empty((count, len(names)), np.float32)
    with np.errstate(over="ignore"):
        for column, name in enumerate(names):
            chosen[:, column] = table[name]
    if OPACITY in names:  # programs that do not clamp write infinite logits for opaque and invisible splats
        logits = chosen[:, names.index(OPACITY)]
        logits[np.isinf(logits)] = np.sign(logits[np.isinf(logits)]) * LARGEST_LOGIT
    if not np.isfinite(chosen).all():
        vertex, column = np.argwhere(~np.isfinite(chosen))[0]
        found = f"{chosen[vertex, column]} in vertex {vertex}"
        raise InputError(path, f"vertex data, {names[column]}", "finite numbers", found)
    return chosen


def read_names(path: Path) -> tuple[str, ...]:
    """The columns of a PLY file from its header. Raises `InputError` as `read_ply` does."""
    with open_regular(path, EXPECTED) as stream:
        return tuple(_header(path, stream.read(HEADER_LIMIT))[1])


def _header(path: Path, content: bytes) -> tuple[int, dict[str, str], int]:
    """Number of vertices, types of their properties by name, and offset of the data."""
    end = END.search(content, 0, HEADER_LIMIT)
    if not BEGIN.match(content) or end is None:
        raise InputError(path, "header", "a PLY header", "none")
    lines = content[: end.start()].decode("ascii", errors="replace").splitlines()
    count = -1
    columns: dict[str, str] = {}
    for line in lines[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format":
            if words[1:] != ["binary_little_endian", "1.0"]:
                raise InputError(path, "format", "binary_little_endian 1.0", " ".join(words[1:]))
        elif words[0] == "element":
            if len(words) != 3 or words[1] != "vertex" or count >= 0 or not _COUNT.fullmatch(words[2]):
                raise InputError(path, "element", "one vertex element", line)
            count = int(words[2])
        elif words[0] == "property":
            if len(words) != 3 or words[1] not in SCALARS or words[2] in columns or count < 0:
                raise InputError(path, "property", "a scalar property of the vertices, each name once", line)
            columns[words[2]] = SCALARS[words[1]]
        else:
            raise InputError(path, "header", "format, element and property lines", line)
    if count < 0 or not columns:
        raise InputError(path, "element", "one vertex element with properties", "none")
    return count, columns, end.end()
