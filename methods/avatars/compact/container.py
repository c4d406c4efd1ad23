"""The file of a coded avatar: a JSON header, and arrays compressed by lzma.

A safetensors file with one uint8 tensor, ``data``, of the compressed arrays one after the other. Its metadata has one key,
``compact``: JSON of `Header`. An array is compressed column by column, since the values of a column are similar; whole numbers
have folded signs (0, -1, 1, -2, ... are 0, 1, 2, 3, ...), and bytes of equal significance lie together.
"""

from __future__ import annotations

import json
import lzma
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from safetensors.numpy import save

from ....bench.contracts import IntArray
from ....bench.errors import InputError
from ....bench.io.arrays import Member
from ....bench.io.documents import checked, parse_json
from ....bench.io.files import write_bytes
from ...shared.avatar_files import COMPACT_FILE
from ...shared.tensor_files import check_tensors, read_safetensors

KEY, DATA, VERSION = "compact", "data", 3
CODEC = "codec"
"""Key of the text that names the codec and its steps, see `CodedAvatar`."""
MOST_NUMBERS = 2**26
"""Maximum numbers of all arrays of a file."""
_LZMA: dict[str, Any] = {"id": lzma.FILTER_LZMA1, "preset": 9, "dict_size": 2**20, "lc": 0, "lp": 0, "pb": 0}


@dataclass(frozen=True)
class Entry:
    """An array in a file: float32, whole numbers, or whole numbers as differences from the row before; of ``width`` bytes each
    before compression, and ``size`` bytes altogether after it."""

    shape: list[int]
    coding: Literal["float", "whole", "differences"]
    width: Literal[1, 2, 4]
    size: int


@dataclass(frozen=True)
class Header:
    """Arrays in the order of their bytes, texts, and steps by name."""

    version: int
    text: dict[str, str]
    steps: dict[str, float]
    arrays: dict[str, Entry]


@dataclass(frozen=True, eq=False)
class Content:
    """Content of such a file: arrays of float32 or of whole numbers below 2^31, texts and steps by name."""

    arrays: Mapping[str, np.ndarray]
    text: Mapping[str, str] = field(default_factory=dict)
    steps: Mapping[str, float] = field(default_factory=dict)


def write_content(path: Path, content: Content) -> dict[str, int]:
    """Write a file atomically; equal content gives equal bytes. Returns the bytes of each array."""
    packed = {name: pack(values) for name, values in content.arrays.items()}
    entries = {name: entry for name, (entry, _) in packed.items()}
    header = asdict(Header(VERSION, dict(content.text), dict(content.steps), entries))
    data = np.frombuffer(b"".join(stream for _, stream in packed.values()), np.uint8)
    write_bytes(path, save({DATA: data}, {KEY: json.dumps(header, separators=(",", ":"))}))
    return {name: entry.size for name, entry in entries.items()}


def read_content(path: Path) -> Content:
    """Read what `write_content` wrote. Raises `InputError` for anything else, before it takes more memory."""
    tensors, metadata = read_safetensors(path)
    header = _header(path, metadata)
    check_tensors(path, tensors, {DATA: Member("u", (None,), dtype="u1")})
    data, start, arrays = tensors[DATA].numpy().tobytes(), 0, {}
    for name, entry in header.arrays.items():
        try:
            arrays[name] = unpack(entry, data[start : start + entry.size])
        except (ValueError, EOFError, lzma.LZMAError) as error:
            raise InputError(path, name, f"an array of shape {tuple(entry.shape)}", str(error)) from error
        start += entry.size
    if start != len(data):
        raise InputError(path, DATA, f"{start} bytes", str(len(data)))
    return Content(arrays, header.text, header.steps)


def codec_of(files: Sequence[Path]) -> str:
    """Codec of an avatar's files; "" for those of a training. Raises `InputError` for a damaged coded file."""
    path = next((path for path in files if path.name == COMPACT_FILE), None)
    return "" if path is None else _header(path, read_safetensors(path)[1]).text.get(CODEC, "")


def _header(path: Path, metadata: Mapping[str, str]) -> Header:
    values = parse_json(metadata.get(KEY, "{}"), path, KEY)
    if values.get("version") != VERSION:
        raise InputError(path, KEY, f"the header of a coded avatar, version {VERSION}", "none or another")
    header: Header = checked(values, Header, path, KEY)
    sizes = [size for entry in header.arrays.values() for size in (*entry.shape, entry.size)]
    numbers = sum(math.prod(entry.shape) for entry in header.arrays.values())
    if (
        min(sizes, default=0) < 0
        or numbers > MOST_NUMBERS
        or not all(e.shape for e in header.arrays.values())
    ):
        raise InputError(path, f"{KEY}, arrays", f"shapes of at most {MOST_NUMBERS} numbers", str(numbers))
    return header


def pack(values: np.ndarray) -> tuple[Entry, bytes]:
    """Compress an array; whole numbers as differences if that is shorter."""
    columns = values.reshape(len(values), math.prod(values.shape[1:])).T
    options: dict[Any, np.ndarray] = {"float": columns.astype("<f4")}
    if values.dtype.kind != "f":
        whole: IntArray = columns.astype(np.int64)
        differences: IntArray = np.diff(whole, axis=1, prepend=0)
        options = {"whole": _folded(whole), "differences": _folded(differences)}
    packed = []
    for coding, numbers in options.items():
        by_significance = np.ascontiguousarray(numbers).view(np.uint8).reshape(-1, numbers.itemsize).T
        stream = lzma.compress(by_significance.tobytes(), format=lzma.FORMAT_RAW, filters=[_LZMA])
        width: Any = numbers.itemsize
        packed.append((Entry(list(values.shape), coding, width, len(stream)), stream))
    return min(packed, key=lambda pair: pair[0].size)


def unpack(entry: Entry, stream: bytes) -> np.ndarray:
    """Inverse of `pack`: float32 or int64. Raises ValueError for a damaged stream and for one of another size."""
    size, rows = math.prod(entry.shape) * entry.width, entry.shape[0]
    decoder = lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=[_LZMA])
    data = decoder.decompress(stream, max_length=size + 1)
    if len(data) != size or not decoder.eof or decoder.unused_data:
        raise ValueError(f"a stream of other than {size} bytes")
    by_significance = np.frombuffer(data, np.uint8).reshape(entry.width, -1)
    numbers = np.ascontiguousarray(by_significance.T).view(
        "<f4" if entry.coding == "float" else f"<u{entry.width}"
    )
    columns = numbers.reshape(-1, rows) if rows else numbers.reshape(0, 0)
    if entry.coding != "float":
        wide = columns.astype(np.int64)
        columns = np.where(wide % 2 == 1, -(wide + 1) // 2, wide // 2)
        columns = np.cumsum(columns, axis=1) if entry.coding == "differences" else columns
    return np.ascontiguousarray(columns.T).reshape(entry.shape)


def _folded(whole: IntArray) -> np.ndarray:
    """Numbers with folded signs in as few bytes as hold them."""
    folded = np.where(whole < 0, -2 * whole - 1, 2 * whole)
    top = int(folded.max(initial=0))
    return folded.astype("<u1" if top < 2**8 else "<u2" if top < 2**16 else "<u4")
