"""Files of tensors, written atomically and checked when read: safetensors, checkpoints, and PLY files of one vertex table.

A checkpoint is a safetensors file. Its metadata has one key, ``checkpoint``: JSON with ``layout``, ``run``, ``state`` and
``digest``. In the state, tensors are referenced by number, and containers have their type.

Formats read:

- PLY of splats. Written by ShenhanQian/GaussianAvatars 30cc4bde (`scene/gaussian_model.py`). Not checked on a file of the program.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.arrays import Member, check_arrays
from ...bench.io.documents import parse_json
from ...bench.io.files import atomic_path, open_regular, read_bytes, reading, write_bytes

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
    """The columns of a PLY file from its header."""
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


MAX_MAGNITUDE = 1e6
"""Maximum magnitude of values of an avatar: network weights, features, positions in units of the triangle."""
MAX_LOGARITHM = 30.0
"""Maximum logarithm of a size; larger ones overflow when they are squared and multiplied."""


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write tensors atomically, real numbers in float32; equal tensors give equal bytes."""
    stored = {}
    for name, value in tensors.items():
        dtype = torch.float32 if value.is_floating_point() else value.dtype
        stored[name] = value.detach().to("cpu", dtype).contiguous()
    write_bytes(path, save(stored, dict(metadata)))


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """All tensors of a file, on the CPU, and its metadata."""
    expected = "a safetensors file"
    with reading(path, expected), safe_open(path, framework="pt", device="cpu") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        metadata = dict(file.metadata() or {})
    return tensors, metadata


def check_tensors(
    path: Path,
    tensors: Mapping[str, Tensor],
    members: Mapping[str, Member],
    sizes: Mapping[str, int] | None = None,
) -> dict[str, int]:
    """`check_arrays` for tensors on the CPU; sizes of the named axes."""
    arrays = {}
    for name in members.keys() & tensors.keys():
        try:
            arrays[name] = tensors[name].numpy()
        except TypeError as error:  # a dtype that numpy lacks
            expected = members[name].dtype or "numbers"
            raise InputError(path, name, expected, str(tensors[name].dtype)) from error
    return check_arrays(path, arrays, members, sizes)


def check_sizes(path: Path, logarithms: Tensor, name: str = "log_scales") -> None:
    """Raise `InputError` for logarithms of sizes beyond `MAX_LOGARITHM`."""
    largest = float(logarithms.max()) if logarithms.numel() else 0.0
    if largest > MAX_LOGARITHM:
        raise InputError(path, name, f"logarithms of sizes up to {MAX_LOGARITHM:g}", f"{largest:g}")


LAYOUT = 2
KEY = "checkpoint"
REMEDY = "Delete it to start over."


def save_checkpoint(path: Path, run: str, state: dict[str, Any]) -> None:
    """Write the state of a run.

    - ``run``: digest of everything the run was started with; `load_checkpoint` refuses files with another digest.
    - ``state``: nested dicts, lists and tuples of tensors, numbers and text.
    """
    tensors: dict[str, Tensor] = {}
    tree = _packed(state, tensors)
    content = {"layout": LAYOUT, "run": run, "state": tree, "digest": _digest(tree, tensors)}
    write_bytes(path, save(tensors, {KEY: json.dumps(content)}))


def load_checkpoint(path: Path, run: str, device: str) -> dict[str, Any] | None:
    """Read the state of a run, or None without a checkpoint."""
    if not path.exists():
        return None
    try:
        tensors, metadata = read_safetensors(path)
        content = parse_json(metadata.get(KEY, ""), path, KEY)
    except InputError as error:
        raise InputError(path, "", "a checkpoint", error.found, REMEDY) from error
    if content.get("layout") != LAYOUT:
        raise InputError(path, "layout", str(LAYOUT), "another layout", REMEDY)
    if content.get("run") != run:
        raise InputError(
            path,
            "run",
            "a checkpoint of this method, clip, settings, budget and seed",
            "one of another run",
            "Use another output folder, or delete it to start over.",
        )
    if content.get("digest") != _digest(content.get("state"), tensors):
        raise InputError(path, "digest", "what was written", "damaged data", REMEDY)
    # Copies, since the rounding of sums also depends on memory alignment.
    copies = {name: value.to(device, copy=True) for name, value in tensors.items()}
    with reading(path, "containers and tensors of the file", "state", REMEDY):
        state = _unpacked(content["state"], copies)
    if not isinstance(state, dict):
        raise InputError(path, "state", "a dictionary", type(state).__name__, REMEDY)
    return state


def _packed(value: Any, tensors: dict[str, Tensor]) -> Any:
    """The value as JSON, with tensors by number."""
    if isinstance(value, Tensor):
        name, strides = str(len(tensors)), value.stride()
        # The order of axes in memory affects the rounding of sums and thus the continued run.
        axes = sorted(range(value.ndim), key=lambda axis: strides[axis], reverse=True)
        # A copy, since a file cannot have two tensors with shared memory.
        ordered = value.detach().permute(axes)
        tensors[name] = ordered.to("cpu", copy=True, memory_format=torch.contiguous_format)
        return {"tensor": [name, axes]}
    if isinstance(value, Mapping):
        return {"dict": [[_packed(key, tensors), _packed(entry, tensors)] for key, entry in value.items()]}
    if isinstance(value, (list, tuple)):
        kind = "list" if isinstance(value, list) else "tuple"
        return {kind: [_packed(entry, tensors) for entry in value]}
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"{type(value).__name__} is not supported in a checkpoint")


def _unpacked(tree: Any, tensors: Mapping[str, Tensor]) -> Any:
    """Inverse of `_packed`."""
    if not isinstance(tree, dict):
        return tree
    ((kind, value),) = tree.items()
    if kind == "tensor":
        name, axes = value
        return tensors[name].permute([axes.index(axis) for axis in range(len(axes))])
    if kind == "float":
        return float(value)
    if kind == "dict":
        return {_unpacked(key, tensors): _unpacked(entry, tensors) for key, entry in value}
    return {"list": list, "tuple": tuple}[kind](_unpacked(entry, tensors) for entry in value)


def _digest(tree: Any, tensors: Mapping[str, Tensor]) -> str:
    state = hashlib.sha256(json.dumps(tree).encode())
    for name, value in sorted(tensors.items()):
        state.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        state.update(value.reshape(-1).view(torch.uint8).numpy())
    return state.hexdigest()
