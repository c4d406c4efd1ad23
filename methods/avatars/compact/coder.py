"""Quantisation of an avatar's arrays by their visible effect, the same steps in both directions, and the file of a coded avatar.

A layout (`layouts`) describes the arrays of a method's avatar once, by calls of a `Coder`, which quantises and stores them, or
reads them back; each call returns the decoded values in both directions.

The file is a safetensors file with one uint8 tensor, ``data``, of the arrays, compressed by lzma, one after the other. Its metadata
has one key, ``compact``: JSON of `Header`. An array is compressed column by column, since the values of a column are similar; whole
numbers have folded signs (0, -1, 1, -2, ... are 0, 1, 2, 3, ...), and bytes of equal significance lie together.
"""

from __future__ import annotations

import json
import lzma
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from safetensors.numpy import save

from ....bench.contracts import FloatArray, IntArray
from ....bench.errors import InputError
from ....bench.io.arrays import Member
from ....bench.io.documents import checked, parse_json
from ....bench.io.files import write_bytes
from ...shared.avatar_files import COMPACT_FILE
from ...shared.tensor_files import check_tensors, read_safetensors
from ..settings import Precision

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
    """Read what `write_content` wrote."""
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
    """Codec of an avatar's files; "" for those of a training."""
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


FINEST, COARSEST = -3, 6
"""Limits of the classes of visibility: steps are multiplied by 2^class."""
BASIS_STEP = 1 / 1024
"""Step of a transform's basis relative to the largest number of a row."""
LEAST_GAIN = 10 * 2 * np.log(2) / 12
"""Minimum gain in squared steps for each number of a row of a basis, which takes about 10 bits: at the rate of a fine uniform
quantiser a bit is worth 2 ln 2 / 12."""


Values = Callable[[], np.ndarray]


@dataclass(frozen=True, eq=False)
class CoderInput:
    """What is encoded."""

    tensors: Mapping[str, np.ndarray]
    """Arrays by name; those of the splats in the order in which they are stored."""
    weights: FloatArray | None = None
    """(N,) `importance` of the splats; None: all are equally visible."""
    metrics: Mapping[str, FloatArray] = field(default_factory=dict)
    """Symmetric positive matrices M by name of vectors: an error e of a vector has the visible squared error e M e. The
    identity for others."""


class Coder:
    """Encodes arrays of a `CoderInput`, or decodes those of a file.

    ``values`` of a call are encoded instead of the array of that name in the source. Decoding raises KeyError for a missing
    array and ValueError for arrays that do not fit each other. ``parts`` has the part of each encoded array: a name of a step of
    `Precision`, or "other".
    """

    def __init__(
        self, precision: Precision, text: Mapping[str, str], given: CoderInput | Mapping[str, np.ndarray]
    ):
        self.precision, self.text = precision, text
        self.source = given if isinstance(given, CoderInput) else None
        self.arrays: dict[str, np.ndarray] = {} if isinstance(given, CoderInput) else dict(given)
        self.parts: dict[str, str] = {}
        self._taken: set[str] = set()

    @property
    def left(self) -> list[str]:
        """Names of arrays of the source that no call took; decoding: of the file."""
        names = self.arrays if self.source is None else self.source.tensors
        return [name for name in names if name not in self._taken]

    def has(self, name: str) -> bool:
        """Whether there is an array of a name."""
        return name in (self.arrays if self.source is None else self.source.tensors)

    def given(self, name: str) -> np.ndarray:
        """The array of a name of the source. It counts as taken."""
        assert self.source is not None
        self._taken.add(name)
        return self.source.tensors[name]

    def _values(self, name: str, values: Values | None) -> np.ndarray | None:
        if self.source is None:
            return None
        return np.asarray(self.given(name) if values is None else values())

    def _pass(self, name: str, values: np.ndarray | None, part: str) -> np.ndarray:
        """Store an array, or read it if there are no ``values``."""
        self._taken.add(name)
        if values is not None:
            self.arrays[name], self.parts[name] = values, part
        return self.arrays[name]

    def _floats(self, name: str, values: np.ndarray | None, part: str) -> FloatArray:
        array = self._pass(name, None if values is None else values.astype(np.float32), part)
        if array.dtype.kind != "f":
            raise ValueError(f"{name} has whole numbers")
        return array

    def _levels(self, name: str, values: np.ndarray | None, part: str) -> IntArray:
        """Whole numbers below 2^30; others are rounded."""
        if values is not None:
            values = np.rint(values.astype(np.float64)).clip(-(2**30), 2**30 - 1).astype(np.int64)
        array = self._pass(name, values, part)
        if array.dtype.kind != "i":
            raise ValueError(f"{name} has no whole numbers")
        return array

    def exact(self, name: str, values: Values | None = None, part: str = "other") -> FloatArray:
        """An array as float32."""
        return self._floats(name, self._values(name, values), part)

    def whole(self, name: str, values: Values | None = None, part: str = "other") -> IntArray:
        """An array of whole numbers below 2^30."""
        return self._levels(name, self._values(name, values), part)

    def rounded(
        self,
        name: str,
        part: str,
        unit: FloatArray | float = 1.0,
        base: FloatArray | float = 0.0,
        values: Values | None = None,
    ) -> FloatArray:
        """An array rounded to multiples of the part's step times ``unit`` from ``base``, float32; exact for step 0."""
        if not (step := getattr(self.precision, part)):
            return self.exact(name, values, part)
        levels, steps = self._values(name, values), step * np.asarray(unit, np.float64)
        levels = None if levels is None else (levels.astype(np.float64) - base) / steps
        return (_times(self._levels(name, levels, part), steps) + base).astype(np.float32)

    def matrix(self, name: str, part: str, step: float, values: FloatArray | None = None) -> FloatArray:
        """Weights with a row for each output, rounded relative to the largest of their row; exact for step 0."""
        weights = self._values(name, None) if values is None else values
        if not step:
            return self._floats(name, weights, part)
        steps = None
        if weights is not None:
            largest = step * np.abs(weights).max(tuple(range(1, weights.ndim)), initial=0, keepdims=True)
            steps = np.where(largest > 0, largest, 1.0)
        steps = self._floats(f"{name}/steps", steps, part).astype(np.float64)
        levels = self._levels(name, None if weights is None else weights / steps, part)
        return _times(levels, steps).astype(np.float32)

    def vectors(
        self,
        name: str,
        part: str,
        step: float | None = None,
        *,
        scale: FloatArray | float = 1.0,
        units: FloatArray | None = None,
        values: Values | None = None,
        weights: FloatArray | None = None,
    ) -> FloatArray:
        """(N, C) vectors through a Karhunen-Loeve transform (V. Goyal, IEEE Signal Processing Magazine 18(5), 2001): in
        coordinates in which equal errors are equally visible and different ones are uncorrelated, one step serves all.

        - ``step``: step of the root of the visible squared error; by default that of the part.
        - ``scale``: (N, 1) factors of the step.
        - ``units``: (N, W) units of the numbers, repeated along the columns; where one is 0, the vectors are exact.
        - ``weights``: to encode: (N,) weights of the vectors in the statistics; by default, those of the splats.
        """
        step = getattr(self.precision, part) if step is None else step
        if not step or (units is not None and not units.all()):
            return self.exact(name, values, part)
        basis = chosen = None
        if self.source is not None:
            given = np.asarray(self._values(name, values), np.float64)
            given = given / _columns(units, given.shape[1])
            metric = self.source.metrics.get(name, np.eye(given.shape[1]))
            shares = self.source.weights if weights is None else weights
            if shares is None or not shares.sum() > 0:
                shares = np.ones(len(given))
            basis, chosen = _transformed(given, metric, shares / max(shares.sum(), 1e-30), step * scale)
        basis = self.matrix(f"{name}/basis", part, BASIS_STEP, basis).astype(np.float64)
        decoded = _times(self._levels(name, chosen, part), step * scale) @ basis
        return (decoded * _columns(units, decoded.shape[1])).astype(np.float32)


def _times(levels: IntArray, steps: FloatArray | float) -> FloatArray:
    if np.ndim(steps) and np.shape(steps)[0] != len(levels):
        raise ValueError(f"{len(levels)} rows of numbers, but {np.shape(steps)[0]} of steps")
    return levels * np.asarray(steps)


def _columns(units: FloatArray | None, count: int) -> FloatArray | float:
    return 1.0 if units is None else units[:, np.arange(count) % units.shape[1]]


def _transformed(
    values: FloatArray, metric: FloatArray, shares: FloatArray, steps: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Rows of the basis, and the levels of the coordinates that are worth more than their row."""
    parts, axes = np.linalg.eigh(np.asarray(metric, np.float64))
    parts = np.maximum(parts, 1e-8 * max(float(parts.max(initial=0)), 1e-12))
    visible, back = (axes * np.sqrt(parts)) @ axes.T, (axes / np.sqrt(parts)) @ axes.T
    seen = values @ visible
    directions = np.linalg.eigh((seen * shares[:, None]).T @ seen)[1][:, ::-1]
    coordinates = seen @ directions / steps
    chosen = np.rint(coordinates)
    gain = (coordinates**2 - (coordinates - chosen) ** 2).sum(0)
    kept = gain > LEAST_GAIN * values.shape[1]
    return (directions.T @ back)[kept], chosen[:, kept]


def visibility_classes(weights: FloatArray | None, count: int) -> IntArray:
    """(N,) classes of visibility, `FINEST` to `COARSEST`, of (N,) mean squared errors per unit of squared error; 0 without.

    The class of an average weight is 0. An error in a class is half as visible as in the class before, so that twice the step
    gives the same mean squared error in the picture.
    """
    if weights is None or not len(weights) or not (mean := float(np.mean(weights, dtype=np.float64))) > 0:
        return np.zeros(count, np.int64)
    ratio = np.maximum(weights / mean, 2.0 ** (-2 * COARSEST - 2))
    return np.clip(np.rint(-0.5 * np.log2(ratio)), FINEST, COARSEST).astype(np.int64)


def scale_of(classes: IntArray, coarsest: int = COARSEST) -> FloatArray:
    """(N, 1) factors of steps."""
    return np.exp2(np.minimum(classes, coarsest).astype(np.float64))[:, None]
