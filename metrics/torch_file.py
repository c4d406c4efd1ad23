"""State dictionaries that ``torch.save`` wrote, read without its loader and only as far as they are asked for.

Why not ``torch.load``: it takes the sizes that a file declares for granted, also with ``weights_only``: a damaged file can make it
take any memory. Both layouts are read: the archive of PyTorch 1.6 and later, and the stream of pickles before it.
"""

from __future__ import annotations

import io
import math
import os
import struct
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..bench.errors import InputError
from ..bench.io.arrays import MAX_DIMENSIONS, check_numbers
from ..bench.io.files import open_regular
from ..bench.io.unpickle import ClosedUnpickler, Function, Malformed, Refused

EXPECTED = "a PyTorch file of weights"
MAGIC, PROTOCOL = 0x1950A86A20F9469CFC6C, 1001
_STORAGES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "?",
}


@dataclass(frozen=True)
class _Storage:
    """Where a tensor's numbers lie: key, type, and how many there are."""

    key: str
    dtype: np.dtype
    count: int

    @property
    def bytes(self) -> int:
        return self.count * self.dtype.itemsize


@dataclass(frozen=True)
class _Tensor:
    """A view of a storage, in numbers and not in bytes."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def of(self, content: bytes) -> np.ndarray:
        """The array, made of its storage's content."""
        flat = np.frombuffer(content, self.storage.dtype)[self.offset :]
        strides = [step * self.storage.dtype.itemsize for step in self.strides]
        view = np.lib.stride_tricks.as_strided(flat, self.shape, strides, writeable=False)
        return np.array(view, dtype=view.dtype.newbyteorder("="), order="C")


class _Ordered(dict):
    """``collections.OrderedDict``, whose attributes nobody reads."""

    def __setstate__(self, state: Any) -> None:
        pass


def read_weights(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Read the tensors named in ``shapes``, which have to be of that shape, floating-point and finite.

    Others are not read. Raises `InputError` for a file that is missing, damaged, of another kind, names anything but
    tensors, or lacks one of these.
    """
    with open_regular(path, EXPECTED) as stream:
        size = os.fstat(stream.fileno()).st_size
        try:
            read = _read_archive if zipfile.is_zipfile(stream) else _read_stream
            stream.seek(0)
            found = read(path, stream, size, shapes)
        except Refused as error:
            raise InputError(path, f"global {error}", EXPECTED, "a name that no weights need") from error
        except InputError:
            raise
        except Exception as error:  # a damaged file makes the unpickler and zipfile raise almost anything
            message = f"one that cannot be read ({type(error).__name__}: {error})"
            raise InputError(path, "", EXPECTED, message) from error
    for name, values in found.items():
        check_numbers(path, name, values)
    return found


def _read_archive(
    path: Path, stream: BinaryIO, size: int, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(stream) as archive:
        # Stored members cannot be larger than the file, whatever its directory says.
        entries = {
            entry.filename: entry
            for entry in archive.infolist()
            if entry.compress_type == zipfile.ZIP_STORED and entry.file_size == entry.compress_size <= size
        }
        (root,) = [name.removesuffix("data.pkl") for name in entries if name.endswith("/data.pkl")]
        if f"{root}byteorder" in entries and archive.read(f"{root}byteorder") != b"little":
            raise Malformed("numbers in big-endian order")
        content = archive.read(f"{root}data.pkl")
        tensors = _select(path, _Pickle(io.BytesIO(content), len(content)).content, shapes)
        found = {}
        for name, tensor in tensors.items():
            member = f"{root}data/{tensor.storage.key}"
            if member not in entries or entries[member].file_size != tensor.storage.bytes:
                raise InputError(path, name, f"{tensor.storage.bytes} bytes of numbers", "another number")
            found[name] = tensor.of(archive.read(member))
    return found


def _read_stream(
    path: Path, stream: BinaryIO, size: int, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """Pickles of two numbers, of a description of the machine, of the tensors, of the storages' keys; then these."""
    magic, protocol, machine = (_Pickle(stream, size).content for _ in range(3))
    if (magic, protocol) != (MAGIC, PROTOCOL):
        raise Malformed("no magic number")
    if not isinstance(machine, dict) or machine.get("little_endian") is not True:
        raise Malformed("no description of the machine, or numbers in big-endian order")
    state = _Pickle(stream, size)
    tensors = _select(path, state.content, shapes)
    places = _places(stream, size, _Pickle(stream, size).content, state.storages)
    found = {}
    for name, tensor in tensors.items():
        start, count = places.get(tensor.storage.key, (0, -1))
        if count != tensor.storage.count:
            raise InputError(path, name, f"{tensor.storage.count} numbers", "another number")
        stream.seek(start)
        found[name] = tensor.of(stream.read(tensor.storage.bytes))
    return found


def _places(
    stream: BinaryIO, size: int, keys: Any, storages: Mapping[str, _Storage]
) -> dict[str, tuple[int, int]]:
    """Start and count of numbers of each storage, which follow each other from where the stream stands."""
    if not isinstance(keys, list) or not all(isinstance(key, str) and key in storages for key in keys):
        raise Malformed("storages that no tensor names")
    places = {}
    for key in keys:
        (count,) = struct.unpack("<q", stream.read(8))
        start = stream.tell()
        end = start + count * storages[key].dtype.itemsize
        if count < 0 or end > size:
            raise Malformed(f"{count} numbers in {size - start} bytes")
        places[key] = start, count
        stream.seek(end)
    return places


class _Pickle:
    """One pickle of a stream, and the storages that it names."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self.storages: dict[str, _Storage] = {}
        self.content = ClosedUnpickler(stream, size, _TABLE, self._storage).load()

    def _storage(self, name: Any) -> _Storage:
        """``("storage", type, key, device, count)``, in the older layout with a sixth that is None."""
        if (
            not isinstance(name, tuple)
            or len(name) not in (5, 6)
            or name[0] != "storage"
            or name[5:] not in ((), (None,))
        ):
            raise Malformed("something else than a storage that is kept elsewhere")
        _, kind, key, _, count = name[:5]
        fits = (
            isinstance(kind, np.dtype) and isinstance(key, str) and type(count) is int and 0 <= count < 2**48
        )
        storage = self.storages.setdefault(key, _Storage(key, kind, count)) if fits else None
        if storage is None or (storage.dtype, storage.count) != (kind, count):
            raise Malformed("a storage of no known type, or of two")
        return storage


def _rebuild(storage: Any, offset: Any, shape: Any, strides: Any, *rest: Any) -> _Tensor:
    """``torch._utils._rebuild_tensor_v2``; what follows the strides matters to training alone."""
    tuples = isinstance(shape, tuple) and isinstance(strides, tuple)
    if not isinstance(storage, _Storage) or not tuples or not len(shape) == len(strides) <= MAX_DIMENSIONS:
        raise Malformed("a tensor without a storage or a shape")
    numbers = (offset, *shape, *strides)
    if not all(type(number) is int and 0 <= number < 2**48 for number in numbers):
        raise Malformed("a tensor of no proper shape")
    last = offset + sum((size - 1) * step for size, step in zip(shape, strides))
    if math.prod(shape) > storage.count or (math.prod(shape) and last >= storage.count):
        raise Malformed("a tensor of more numbers than its storage has")
    return _Tensor(storage, offset, shape, strides)


def _ordered(items: Any = ()) -> _Ordered:
    pairs = isinstance(items, (list, tuple)) and all(
        isinstance(item, (list, tuple)) and len(item) == 2 for item in items
    )
    if not pairs or not all(isinstance(item[0], str) for item in items):
        raise Malformed("a dictionary without names")
    return _Ordered(items)


_TABLE: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): Function(_ordered),
    ("torch._utils", "_rebuild_tensor"): Function(_rebuild),
    ("torch._utils", "_rebuild_tensor_v2"): Function(_rebuild),
    ("torch._utils", "_rebuild_parameter"): Function(lambda tensor, *rest: tensor),
    **{("torch", name): np.dtype(code) for name, code in _STORAGES.items()},
}


def _select(path: Path, content: Any, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, _Tensor]:
    """The tensors wanted, by name."""
    if not isinstance(content, dict):
        raise InputError(path, "", "a dictionary of tensors", type(content).__name__)
    found: dict[str, _Tensor] = {}
    for name, shape in shapes.items():
        tensor, expected = content.get(name), f"a float tensor of shape {shape}"
        if tensor is None:
            raise InputError(path, name, expected, "no such entry", "Is it the file of another network?")
        if not isinstance(tensor, _Tensor) or tensor.storage.dtype.kind != "f":
            kind = tensor.storage.dtype if isinstance(tensor, _Tensor) else type(tensor).__name__
            raise InputError(path, name, expected, str(kind))
        if tensor.shape != shape:
            raise InputError(path, name, expected, f"shape {tensor.shape}")
        found[name] = tensor
    return found
