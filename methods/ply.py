"""PLY files of one float32 vertex table: what splat viewers open."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..bench.contracts import FloatArray
from ..bench.errors import InputError
from ..bench.files import atomic_path

FLOAT_NAMES = ("float", "float32")
HEADER_LIMIT = 65536  # bytes; a longer header is no file of ours


def write_ply(path: Path, names: tuple[str, ...], table: FloatArray) -> None:
    """Write an (N, len(names)) table as binary little-endian float32 vertices, whole or not at all."""
    if table.ndim != 2 or table.shape[1] != len(names):
        raise ValueError(f"table: expected (N, {len(names)}), found {table.shape}")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in names]
    header.append("end_header")
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(("\n".join(header) + "\n").encode("ascii"))
        stream.write(np.ascontiguousarray(table, dtype="<f4").tobytes())


def read_ply(path: Path, names: tuple[str, ...]) -> FloatArray:
    """Read the named columns of a binary little-endian float32 vertex table as (N, len(names)).

    Raises `InputError` where the file is no such PLY, lacks a column, is cut short, or holds non-finite numbers.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(path, "", "a PLY file", error.strerror or str(error)) from error
    marker = b"end_header\n"
    end = content.find(marker, 0, HEADER_LIMIT)
    if not content.startswith(b"ply\n") or end < 0:
        raise InputError(path, "header", "a PLY header", "none")
    count, columns = _parse_header(path, content[:end].decode("ascii", errors="replace").splitlines())
    missing = [name for name in names if name not in columns]
    if missing:
        raise InputError(path, missing[0], "a property of that name", f"{len(columns)} others")
    body = content[end + len(marker) :]
    size = count * len(columns) * 4
    if len(body) != size:
        raise InputError(path, "vertex data", f"{size} bytes", f"{len(body)}")
    table = np.frombuffer(body, dtype="<f4").reshape(count, len(columns))
    chosen = table[:, [columns.index(name) for name in names]].astype(np.float32)
    if not np.isfinite(chosen).all():
        raise InputError(path, "vertex data", "finite numbers", "NaN or infinity")
    return chosen


def _parse_header(path: Path, lines: list[str]) -> tuple[int, list[str]]:
    count, columns = -1, []
    for line in lines[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format":
            if words[1:] != ["binary_little_endian", "1.0"]:
                raise InputError(path, "format", "binary_little_endian 1.0", " ".join(words[1:]))
        elif words[0] == "element":
            if len(words) != 3 or words[1] != "vertex" or count >= 0 or not words[2].isdigit():
                raise InputError(path, "element", "one vertex element", line)
            count = int(words[2])
        elif words[0] == "property":
            if len(words) != 3 or words[1] not in FLOAT_NAMES:
                raise InputError(path, "property", "a float property", line)
            columns.append(words[2])
        else:
            raise InputError(path, "header", "format, element and property lines", line)
    if count < 0:
        raise InputError(path, "element", "one vertex element", "none")
    return count, columns
