"""The file of a coded avatar: packed arrays by name in one safetensors file, with their shapes beside them.

Layout
------
* The metadata has one key, ``compact``: JSON with ``version`` (2), ``text`` (strings by name), ``steps`` (numbers by
  name), ``arrays``: for each array ``[dtype, shape]``, and ``tables``: lists of names of arrays of whole numbers that are
  coded together.
* Each tensor is a one-dimensional uint8 stream: of `entropy.encode` for a table, under the name of its first array, and of
  `pack` for every other array. Files of version 1, which have no tables, are read, too.
"""

from __future__ import annotations

import json
import lzma
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from ....bench.contracts import FloatArray, IntArray
from ....bench.errors import InputError
from ....bench.io.arrays import Member
from ....bench.io.documents import parse_json
from ....bench.io.files import write_bytes
from ...shared.avatar_files import COMPACT_FILE
from ...shared.tensor_files import check_tensors, read_safetensors
from . import entropy

KEY, VERSION = "compact", 2
MAX_ARRAYS = 256
MAX_ROWS = 4096
"""Maximum number of rows of a table."""
FEW_COLUMNS = 512
"""Arrays whose last axis is shorter are one row of a table."""
MOST, MOST_PER_BYTE = 2**22, 64
"""Maximum number of array elements in a file: 4 million plus 64 per packed byte. Avatars have one to ten per byte; the
coders pack zeros ten thousand times smaller."""


@dataclass(frozen=True, eq=False)
class Content:
    """Content of such a file: arrays of the types of `DTYPES`, texts and steps by name.

    Arrays of whole numbers are coded in their order; each can be conditioned on those before it with as many columns.
    """

    arrays: Mapping[str, np.ndarray]
    text: Mapping[str, str] = field(default_factory=dict)
    steps: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Packed:
    """Streams of the arrays of a file by name, names of the arrays in each table, and bytes by array."""

    streams: Mapping[str, bytes]
    tables: Sequence[Sequence[str]]
    sizes: Mapping[str, int]


def packed(arrays: Mapping[str, np.ndarray]) -> Packed:
    """Code arrays: tables of whole numbers where that is shorter, else each array by itself."""
    streams: dict[str, bytes] = {}
    tables: list[list[str]] = []
    sizes: dict[str, int] = {}
    alone = {name: pack(values) for name, values in arrays.items()}
    by_columns: dict[int, list[str]] = {}
    for name, values in arrays.items():
        rows, columns = _table_shape(values.shape)
        if values.dtype.kind == "u" and rows <= MAX_ROWS and rows * columns:
            by_columns.setdefault(columns, []).append(name)
    for names in by_columns.values():
        table = [row for name in names for row in arrays[name].reshape(_table_shape(arrays[name].shape))]
        stream, bits = entropy.encode(table) if len(table) <= MAX_ROWS else (b"", np.zeros(0))
        if stream and len(stream) < sum(len(alone[name]) for name in names):
            streams[names[0]] = stream
            tables.append(names)
            ends = np.cumsum([_table_shape(arrays[name].shape)[0] for name in names])
            parts = [float(part.sum()) / 8 for part in np.split(bits, ends[:-1])]
            sizes |= {name: math.ceil(part) for name, part in zip(names, parts)}
    together = {name for names in tables for name in names}
    streams |= {name: stream for name, stream in alone.items() if name not in together}
    sizes |= {name: len(stream) for name, stream in alone.items() if name not in together}
    return Packed(streams, tables, sizes)


def packed_sizes(arrays: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Bytes that each array takes in a file."""
    return dict(packed(arrays).sizes)


def write_content(path: Path, content: Content) -> None:
    """Write a file atomically; equal content gives equal bytes."""
    coded_arrays = packed(content.arrays)
    streams = {name: np.frombuffer(stream, np.uint8) for name, stream in coded_arrays.streams.items()}
    arrays = {name: [values.dtype.str[1:], list(values.shape)] for name, values in content.arrays.items()}
    layout = {"version": VERSION, "text": dict(content.text), "steps": dict(content.steps), "arrays": arrays}
    layout["tables"] = coded_arrays.tables
    write_bytes(path, save(streams, {KEY: json.dumps(layout, separators=(",", ":"))}))


def read_content(path: Path) -> Content:
    """Read what `write_content` wrote.

    Sizes are checked before anything is unpacked, see `MOST`. Raises `InputError` for anything else.
    """
    tensors, metadata = read_safetensors(path)
    layout = _layout(path, metadata, sum(value.nbytes for value in tensors.values()))
    tables = {names[0]: names for names in layout["tables"]}
    together = {name for names in layout["tables"] for name in names[1:]}
    if set(tensors) != set(layout["arrays"]) - together:
        found = ", ".join(sorted(set(tensors).symmetric_difference(set(layout["arrays"]) - together)))
        raise InputError(path, KEY, "the file's tensors and no others", f"a difference in {found}")
    check_tensors(path, tensors, dict.fromkeys(tensors, Member("u", (None,), dtype="u1")))
    arrays: dict[str, np.ndarray] = {}
    for name, stream in sorted(tensors.items()):
        expected = {each: layout["arrays"][each] for each in tables.get(name, [name])}
        try:
            if name in tables:
                arrays |= _unpack_table(stream.numpy().tobytes(), expected)
            else:
                dtype, shape = expected[name]
                arrays[name] = unpack(stream.numpy().tobytes(), dtype, tuple(shape))
        except ValueError as error:
            dtype, shape = expected[name]
            raise InputError(path, name, f"{dtype} of shape {tuple(shape)}", str(error)) from error
    return Content({name: arrays[name] for name in layout["arrays"]}, layout["text"], layout["steps"])


CODEC = "codec"
"""Key of the text that names the codec and its steps, see `CodedAvatar`."""


def codec_of(files: Sequence[Path]) -> str:
    """Codec of an avatar's files; "" for those of a training. Raises `InputError` for a damaged coded file."""
    path = next((path for path in files if path.name == COMPACT_FILE), None)
    if path is None:
        return ""
    _, metadata = read_safetensors(path)
    text = parse_json(metadata.get(KEY, "{}"), path, KEY).get("text", {})
    return str(text.get(CODEC, "1")) if isinstance(text, dict) else "1"


def _table_shape(shape: Sequence[int]) -> tuple[int, int]:
    """Rows and columns of an array in a table."""
    size = math.prod(shape)
    few = not shape or shape[-1] < FEW_COLUMNS
    return (1, size) if few else (size // shape[-1], shape[-1])


def _unpack_table(stream: bytes, expected: Mapping[str, tuple[str, list[int]]]) -> dict[str, np.ndarray]:
    """The arrays of a table with their types and shapes. Raises ValueError for a damaged stream."""
    shapes = {name: _table_shape(shape) for name, (_, shape) in expected.items()}
    rows, columns = sum(rows for rows, _ in shapes.values()), {columns for _, columns in shapes.values()}
    if len(columns) != 1 or rows > MAX_ROWS or any(dtype[0] != "u" for dtype, _ in expected.values()):
        raise ValueError("a table of arrays that do not belong together")
    found = iter(entropy.decode(stream, rows, columns.pop()))
    arrays = {}
    for name, (dtype, shape) in expected.items():
        values = np.stack([next(found) for _ in range(shapes[name][0])])
        if int(values.max(initial=0)) > np.iinfo(DTYPES[dtype]).max:
            raise ValueError(f"numbers larger than {dtype} holds")
        arrays[name] = values.astype(DTYPES[dtype]).reshape(shape)
    return arrays


def _layout(path: Path, metadata: Mapping[str, str], size: int) -> dict[str, Any]:
    """The checked JSON metadata of a file with this number of packed bytes."""
    layout = parse_json(metadata.get(KEY, "{}"), path, KEY)
    if layout.get("version") not in (1, VERSION):
        raise InputError(
            path, KEY, f"the layout of a compact avatar, version 1 or {VERSION}", "none or another"
        )
    arrays, text, steps = (layout.get(name) for name in ("arrays", "text", "steps"))
    if not isinstance(arrays, dict) or len(arrays) > MAX_ARRAYS or not all(map(_is_entry, arrays.values())):
        expected = f"up to {MAX_ARRAYS} times [type, shape], types among {', '.join(DTYPES)}"
        raise InputError(path, f"{KEY}, arrays", expected, repr(arrays)[:200])
    numbers, limit = sum(math.prod(shape) for _, shape in arrays.values()), MOST + MOST_PER_BYTE * size
    if numbers > limit:
        raise InputError(path, f"{KEY}, arrays", f"at most {limit} numbers in {size} bytes", f"{numbers}")
    if not isinstance(text, dict) or not all(isinstance(value, str) for value in text.values()):
        raise InputError(path, f"{KEY}, text", "strings by name", repr(text)[:200])
    if not isinstance(steps, dict) or not all(map(_is_step, steps.values())):
        raise InputError(path, f"{KEY}, steps", "numbers from 0 to 1 by name", repr(steps)[:200])
    tables = layout.setdefault("tables", [])
    listed = isinstance(tables, list) and all(isinstance(names, list) and names for names in tables)
    names = [name for names in tables for name in names] if listed else [None]
    if not all(isinstance(name, str) and name in arrays for name in names) or len(set(names)) != len(names):
        raise InputError(path, f"{KEY}, tables", "lists of names of arrays, each once", repr(tables)[:200])
    return layout


def _is_entry(entry: Any) -> bool:
    if not isinstance(entry, list) or len(entry) != 2 or not isinstance(entry[1], list):
        return False
    dtype, shape = entry
    whole = len(shape) <= 4 and all(type(size) is int and 0 <= size <= MAX_BYTES for size in shape)
    return isinstance(dtype, str) and dtype in DTYPES and whole


def _is_step(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value < 1


MAX_BYTES = 2**28
"""No array of an avatar is larger than this when unpacked."""

_FILTERS: list[dict[str, Any]] = [
    {"id": lzma.FILTER_LZMA1, "preset": 9, "dict_size": 2**20, "lc": 0, "lp": 0, "pb": 0}
]

DTYPES = {name: np.dtype(f"<{name}") for name in ("u1", "u2", "u4", "f2", "f4")}
"""Types that can be packed, little-endian."""


def pack(values: np.ndarray) -> bytes:
    """Compress an array of one of `DTYPES`; the bytes of equal significance lie together."""
    data = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"), copy=False))
    by_significance = data.reshape(-1, 1).view(np.uint8).reshape(-1, data.itemsize).T
    return lzma.compress(by_significance.tobytes(), format=lzma.FORMAT_RAW, filters=_FILTERS)


def unpack(packed: bytes, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """Inverse of `pack` for a known shape and one of `DTYPES`.

    Decompression stops as soon as a stream exceeds their size, which bounds memory. Raises ValueError for a damaged
    stream and for one with another number of bytes.
    """
    kind = DTYPES[dtype]
    size = int(np.prod(shape, dtype=object)) * kind.itemsize
    if size > MAX_BYTES:
        raise ValueError(f"an array of {size} bytes, more than {MAX_BYTES}")
    decoder = lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=_FILTERS)
    try:
        content = decoder.decompress(packed, max_length=size + 1)
    except (lzma.LZMAError, EOFError) as error:
        raise ValueError(f"a damaged stream ({error})") from error
    if len(content) != size or not decoder.eof or decoder.unused_data:
        raise ValueError(f"a stream of other than {size} bytes")
    by_significance = np.frombuffer(content, np.uint8).reshape(kind.itemsize, -1)
    return np.ascontiguousarray(by_significance.T).reshape(-1).view(kind).reshape(shape)


def coded(values: FloatArray, step: FloatArray | float) -> np.ndarray:
    """Small integers for a step above 0, else the float32 numbers themselves."""
    if np.all(np.asarray(step) > 0):
        return quantise(values, step)
    return np.asarray(values, np.float32)


class Arrays:
    """Arrays of a file; each can be taken once. Raises `InputError` where one is missing or of another size."""

    def __init__(self, path: Path, content: Content):
        self.path, self.steps, self.text = path, content.steps, content.text
        self._left: dict[str, np.ndarray] = dict(content.arrays)

    @property
    def names(self) -> list[str]:
        """Names of the arrays that were not taken."""
        return list(self._left)

    def __contains__(self, name: str) -> bool:
        return name in self._left

    def step(self, name: str) -> float:
        """A step by name."""
        if name not in self.steps:
            raise InputError(self.path, f"steps, {name}", "a number", "none")
        return float(self.steps[name])

    def take(self, name: str, *shape: int | None) -> np.ndarray:
        """Take an array by name and shape; None in the shape matches any size."""
        if name not in self._left:
            raise InputError(self.path, name, "an array of that name", "none")
        values = self._left.pop(name)
        wanted = tuple(has if want is None else want for want, has in zip(shape, values.shape))
        if len(shape) != values.ndim or wanted != values.shape:
            expected = ", ".join("any" if size is None else str(size) for size in shape)
            raise InputError(self.path, name, f"shape ({expected})", f"shape {values.shape}")
        return values

    def integers(self, name: str, *shape: int | None) -> np.ndarray:
        """Take an array of integers."""
        values = self.take(name, *shape)
        if values.dtype.kind != "u":
            raise InputError(self.path, name, "whole numbers", str(values.dtype))
        return values

    def floats(self, name: str, *shape: int | None) -> FloatArray:
        """Take an array of finite float32 numbers."""
        values = self.take(name, *shape)
        if values.dtype.kind != "f" or not np.isfinite(values).all():
            raise InputError(self.path, name, "finite numbers", f"{values.dtype} or non-finite numbers")
        return values.astype(np.float32)

    def decoded(self, name: str, step: FloatArray | float, *shape: int | None) -> FloatArray:
        """Inverse of `coded` up to rounding, as float32."""
        if name in self._left and self._left[name].dtype.kind == "f":
            return self.floats(name, *shape)
        return dequantise(self.integers(name, *shape), step)

    def drop(self, name: str) -> None:
        """Remove an array if it exists."""
        self._left.pop(name, None)

    def rest(self) -> Mapping[str, FloatArray]:
        """Remaining arrays; they must be float32 throughout and are stored as they are."""
        return {name: self.floats(name, *values.shape) for name, values in list(self._left.items())}


def quantise(values: FloatArray, step: FloatArray | float) -> np.ndarray:
    """Round to multiples of ``step`` (broadcast) and fold the signs: 0, -1, 1, -2, ... become 0, 1, 2, 3, ...

    Returns the smallest of uint8, uint16, uint32 that holds them all; beyond 31 bits values are clamped.
    """
    whole = np.rint(np.asarray(values, np.float64) / step).clip(-(2**30), 2**30 - 1).astype(np.int64)
    return narrow(fold(whole))


def fold(whole: IntArray) -> IntArray:
    """Whole numbers with folded signs: 0, -1, 1, -2, ... become 0, 1, 2, 3, ..."""
    return np.where(whole < 0, -2 * whole - 1, 2 * whole)


def dequantise(folded: np.ndarray, step: FloatArray | float) -> FloatArray:
    """The multiples of ``step`` that `quantise` rounded to, float32."""
    wide = folded.astype(np.int64)
    whole = np.where(wide % 2 == 1, -(wide + 1) // 2, wide // 2)
    with np.errstate(over="ignore"):  # overflow gives infinity, which is refused
        return (whole * np.asarray(step, np.float64)).astype(np.float32)


def narrow(values: np.ndarray) -> np.ndarray:
    """Non-negative integers in the smallest sufficient unsigned type of 1, 2 or 4 bytes."""
    top = int(values.max(initial=0))
    return values.astype(np.uint8 if top < 2**8 else np.uint16 if top < 2**16 else np.uint32)


def smallest_three(quats: FloatArray) -> FloatArray:
    """(N, 3) imaginary parts of quaternions (w, x, y, z) that turn a Gaussian as the given ones do, with w largest.

    Half a turn about an axis of a Gaussian and the sign of its quaternion do not change it; one of these changes moves
    the largest component to the front and makes it positive. Neither its index nor its sign needs to be stored, and no
    stored component exceeds 1/sqrt(2).
    """
    unit = np.asarray(quats, np.float64)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    w, x, y, z = unit.T
    # q, q i, q j, q k (Hamilton): half turns about the splat's own axes.
    turns = (w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)
    turned = np.stack([np.stack(q, axis=1) for q in turns])
    best = np.abs(turned[:, :, 0]).argmax(0)
    chosen = turned[best, np.arange(len(unit))]
    return chosen[:, 1:] * np.where(chosen[:, :1] < 0, -1.0, 1.0)


def from_smallest_three(imaginary: FloatArray) -> FloatArray:
    """(N, 4) unit quaternions of (N, 3) imaginary parts; float32."""
    parts = np.asarray(imaginary, np.float64)
    real = np.sqrt(np.maximum(1 - (parts**2).sum(1, keepdims=True), 0))
    quats = np.concatenate([real, parts], axis=1)
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)
