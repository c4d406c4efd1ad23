"""The file of a compact avatar: packed arrays by name in one safetensors file, with their shapes beside them.

Layout
------
* Each tensor is a one-dimensional uint8 stream of `packing.pack`.
* The metadata has one key, ``compact``: JSON with ``version`` (1), ``text`` (strings by name), ``steps`` (numbers by
  name) and ``arrays``: for each tensor ``[dtype, shape]``.
"""

from __future__ import annotations

import json
import lzma
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from ....bench.contracts import FloatArray
from ....bench.errors import InputError
from ....bench.io.arrays import Member
from ....bench.io.documents import parse_json
from ....bench.io.files import write_bytes
from ...shared.tensor_files import check_tensors, read_safetensors

KEY, VERSION = "compact", 1
MAX_ARRAYS = 64
MOST, MOST_PER_BYTE = 2**22, 16
"""Maximum number of array elements in a file: 4 million plus 16 per packed byte. Avatars have one or two per byte; the
coder packs zeros ten thousand times smaller."""


@dataclass(frozen=True, eq=False)
class Content:
    """Content of such a file: arrays of the types of `packing.DTYPES`, texts and steps by name."""

    arrays: Mapping[str, np.ndarray]
    text: Mapping[str, str] = field(default_factory=dict)
    steps: Mapping[str, float] = field(default_factory=dict)


def packed_sizes(arrays: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Bytes that each array takes in a file."""
    return {name: len(pack(values)) for name, values in arrays.items()}


def write_content(path: Path, content: Content) -> None:
    """Write a file whole or not at all; equal content gives equal bytes."""
    packed = {name: np.frombuffer(pack(values), np.uint8) for name, values in content.arrays.items()}
    arrays = {name: [values.dtype.str[1:], list(values.shape)] for name, values in content.arrays.items()}
    layout = {"version": VERSION, "text": dict(content.text), "steps": dict(content.steps), "arrays": arrays}
    write_bytes(path, save(packed, {KEY: json.dumps(layout, separators=(",", ":"))}))


def read_content(path: Path) -> Content:
    """Read what `write_content` wrote.

    Sizes are checked before anything is unpacked, see `MOST`. Raises `InputError` for anything else.
    """
    tensors, metadata = read_safetensors(path)
    layout = _layout(path, metadata, sum(value.nbytes for value in tensors.values()))
    if set(tensors) != set(layout["arrays"]):
        found = ", ".join(sorted(set(tensors).symmetric_difference(layout["arrays"])))
        raise InputError(path, KEY, "the file's tensors and no others", f"a difference in {found}")
    check_tensors(path, tensors, dict.fromkeys(tensors, Member("u", (None,), dtype="u1")))
    arrays = {}
    for name, stream in sorted(tensors.items()):
        dtype, shape = layout["arrays"][name]
        try:
            arrays[name] = unpack(stream.numpy().tobytes(), dtype, tuple(shape))
        except ValueError as error:
            raise InputError(path, name, f"{dtype} of shape {tuple(shape)}", str(error)) from error
    return Content(arrays, layout["text"], layout["steps"])


def _layout(path: Path, metadata: Mapping[str, str], packed: int) -> dict[str, Any]:
    """The checked JSON metadata of a file with this number of packed bytes."""
    layout = parse_json(metadata.get(KEY, "{}"), path, KEY)
    if layout.get("version") != VERSION:
        raise InputError(path, KEY, f"the layout of a compact avatar, version {VERSION}", "none or another")
    arrays, text, steps = (layout.get(name) for name in ("arrays", "text", "steps"))
    if not isinstance(arrays, dict) or len(arrays) > MAX_ARRAYS or not all(map(_is_entry, arrays.values())):
        expected = f"up to {MAX_ARRAYS} times [type, shape], types among {', '.join(DTYPES)}"
        raise InputError(path, f"{KEY}, arrays", expected, repr(arrays)[:200])
    numbers, limit = sum(math.prod(shape) for _, shape in arrays.values()), MOST + MOST_PER_BYTE * packed
    if numbers > limit:
        raise InputError(path, f"{KEY}, arrays", f"at most {limit} numbers in {packed} bytes", f"{numbers}")
    if not isinstance(text, dict) or not all(isinstance(value, str) for value in text.values()):
        raise InputError(path, f"{KEY}, text", "strings by name", repr(text)[:200])
    if not isinstance(steps, dict) or not all(map(_is_step, steps.values())):
        raise InputError(path, f"{KEY}, steps", "numbers from 0 to 1 by name", repr(steps)[:200])
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

    def rest(self) -> Mapping[str, FloatArray]:
        """Remaining arrays; they must be float32 throughout and are stored as they are."""
        return {name: self.floats(name, *values.shape) for name, values in list(self._left.items())}


def quantise(values: FloatArray, step: FloatArray | float) -> np.ndarray:
    """Round to multiples of ``step`` (broadcast) and fold the signs: 0, -1, 1, -2, ... become 0, 1, 2, 3, ...

    Returns the smallest of uint8, uint16, uint32 that holds them all; beyond 31 bits values are clamped.
    """
    whole = np.rint(np.asarray(values, np.float64) / step).clip(-(2**30), 2**30 - 1).astype(np.int64)
    return narrow(np.where(whole < 0, -2 * whole - 1, 2 * whole))


def dequantise(folded: np.ndarray, step: FloatArray | float) -> FloatArray:
    """The multiples of ``step`` that `quantise` rounded to, float32."""
    wide = folded.astype(np.int64)
    whole = np.where(wide % 2 == 1, -(wide + 1) // 2, wide // 2)
    with np.errstate(over="ignore"):  # overflow gives infinity, which is refused
        return (whole * np.asarray(step, np.float64)).astype(np.float32)


def narrow(values: np.ndarray) -> np.ndarray:
    """Non-negative integers in the smallest unsigned type of 1, 2 or 4 bytes."""
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
