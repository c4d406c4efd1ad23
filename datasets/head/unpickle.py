"""Read the arrays in a FLAME pickle without running anything the file asks for.

A pickle is a program that may call whatever it can import. FLAME and its masks come as Python-2 pickles full
of chumpy and scipy objects, so they cannot be turned down; instead every name in the stream is looked up in a
closed table of stand-ins (see `bench.unpickle`). A stand-in only keeps what it is given; arrays are built at the
end from raw bytes, after their declared types and sizes have been checked against those bytes, and never more than
the file has. No class or function of numpy, scipy or chumpy is ever handed to the stream.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Self, cast

import numpy as np

from ...bench.errors import InputError
from ...bench.io.files import read_bytes
from ...bench.io.unpickle import ClosedUnpickler, Function, Malformed, Refused

MAX_DENSE_ELEMENTS = 5_000_000
"""Of all sparse matrices of a file together: a few bytes can declare any shape. A joint regressor has 25,000."""
MAX_BYTES = 2**30
"""Of a file; the largest of FLAME has 0.1 GB."""
MAX_DIMENSIONS = 8

_KINDS = "fiub"
_DATA = (np.ndarray, str, bytes, int, float, complex, type(None), list, tuple, dict)
_ByteOrder = Literal["<", ">", "|", "="]


@dataclass
class _Budget:
    """What may still be made of a file: bytes of arrays, and elements of dense matrices."""

    raw: int
    dense: int = MAX_DENSE_ELEMENTS

    def take(self, *, raw: int = 0, dense: int = 0) -> None:
        """Raise `Malformed` where more is wanted than is left."""
        self.raw, self.dense = self.raw - raw, self.dense - dense
        if self.raw < 0:
            raise Malformed("arrays of more bytes than the file has")
        if self.dense < 0:
            raise Malformed(f"sparse matrices of more than {MAX_DENSE_ELEMENTS} elements")


class _DType:
    """``numpy.dtype(name, align, copy)`` and its state (version, byte order, sub-array, names, fields, ...)."""

    __slots__ = ("name", "order")

    def __init__(self, name: Any, align: Any = False, copy: Any = False) -> None:
        if not isinstance(name, str):
            raise Malformed("a dtype without a name")
        self.name = name
        self.order: _ByteOrder = "="

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or any(part is not None for part in state[2:5]):
            raise Malformed("a structured or malformed dtype")
        if state[1] not in ("<", ">", "|", "="):
            raise Malformed("a dtype without a byte order")
        self.order = cast(_ByteOrder, state[1])

    def resolve(self) -> np.dtype[Any]:
        """The numpy dtype: booleans, integers and floats only."""
        known = len(self.name) <= 3 and self.name[:1] in {*_KINDS} and self.name[1:].isdecimal()
        if not known:
            raise Malformed(f"an array of dtype {self.name[:20]!r}")
        try:
            resolved = np.dtype(self.name).newbyteorder(self.order)
        except TypeError as error:
            raise Malformed(f"an array of dtype {self.name!r}") from error
        if resolved.itemsize > 8:
            raise Malformed(f"an array of dtype {self.name!r}")
        return resolved


class _Text:
    """Bytes as Python 3 writes them in old protocols: text that stands for them."""

    __slots__ = ("text",)

    def __init__(self, text: Any, encoding: Any = "latin1") -> None:
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise Malformed("text in an unexpected encoding")
        self.text = text

    def __setstate__(self, state: Any) -> None:
        raise Malformed("text with a state")


class _Array:
    """``numpy.ndarray`` between its reconstruction and its state (version, shape, dtype, fortran, bytes)."""

    __slots__ = ("_values", "parts")

    def __init__(self, *parts: Any) -> None:
        self.parts: tuple[Any, ...] = parts  # bytes, dtype, shape, order
        self._values: np.ndarray | None = None

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise Malformed("an array with an unknown kind of state")
        _, shape, dtype, fortran, raw = state
        self.__init__(raw, dtype, shape, "F" if fortran else "C")  # type: ignore[misc]

    def values(self, budget: _Budget) -> np.ndarray:
        """The array, made once."""
        if not getattr(self, "parts", ()):
            raise Malformed("an array without content")
        if self._values is None:
            raw, dtype, shape, order = self.parts
            self._values = _from_bytes(raw, dtype, shape, order, budget)
        return self._values


class _Instance:
    """An object of a class that is not there: its instance dictionary, made an array once everything is read."""

    __slots__ = ("state",)

    def __new__(cls, *arguments: Any) -> Self:
        return super().__new__(cls)

    def __setstate__(self, state: Any) -> None:
        # Python may wrap the dictionary in a pair with the slots' state.
        if isinstance(state, tuple) and len(state) == 2 and not state[1]:
            state = state[0]
        if not isinstance(state, dict):
            raise Malformed("an object whose state is no dictionary")
        self.state: dict[Any, Any] = state

    def array(self, budget: _Budget) -> np.ndarray:
        """The values."""
        raise NotImplementedError


class _Sparse(_Instance):
    """A scipy.sparse matrix."""

    __slots__ = ()
    layout = ""

    def array(self, budget: _Budget) -> np.ndarray:
        """(rows, columns) array; entries at the same place add up, as in scipy."""
        shape = _shape(self.state.get("_shape"))
        if len(shape) != 2 or math.prod(shape) > MAX_DENSE_ELEMENTS:
            raise Malformed(f"a sparse matrix of shape {shape}")
        budget.take(dense=math.prod(shape))
        data = self._part("data", _KINDS, budget)
        rows, columns = self._coordinates(shape, budget)
        if not len(rows) == len(columns) == len(data):
            raise Malformed("a sparse matrix whose parts differ in length")
        for indices, size in ((rows, shape[0]), (columns, shape[1])):
            if indices.size and not (0 <= indices.min() and indices.max() < size):
                raise Malformed("a sparse matrix with indices out of range")
        matrix = np.zeros(shape, dtype=data.dtype)
        np.add.at(matrix, (rows, columns), data)
        return matrix

    def _coordinates(self, shape: tuple[int, ...], budget: _Budget) -> tuple[np.ndarray, np.ndarray]:
        if self.layout == "coo":
            coords = self.state.get("coords")
            if isinstance(coords, tuple) and len(coords) == 2:  # as scipy keeps them since 1.11
                self.state |= dict(zip(("row", "col"), coords))
            return self._part("row", "iu", budget), self._part("col", "iu", budget)
        minor = self._part("indices", "iu", budget)
        pointers = self._part("indptr", "iu", budget).astype(np.int64)
        lines = shape[1] if self.layout == "csc" else shape[0]
        counts = np.diff(pointers)
        if len(pointers) != lines + 1 or pointers[0] != 0 or (counts < 0).any() or pointers[-1] != len(minor):
            raise Malformed("a sparse matrix with broken row or column pointers")
        major = np.repeat(np.arange(lines), counts)
        return (minor, major) if self.layout == "csc" else (major, minor)

    def _part(self, name: str, kinds: str, budget: _Budget) -> np.ndarray:
        values = _plain(self.state.get(name), budget)
        if not isinstance(values, np.ndarray) or values.dtype.kind not in kinds:
            raise Malformed(f"a sparse matrix without {name}")
        return values.ravel()


_SPARSE = {
    layout: type(f"_{layout}_matrix", (_Sparse,), {"__slots__": (), "layout": layout})
    for layout in ("csc", "csr", "coo")
}


class _Chumpy(_Instance):
    """``chumpy.ch.Ch``: a plain array under the key x."""

    __slots__ = ()

    def array(self, budget: _Budget) -> np.ndarray:
        values = self.state.get("x")
        if not isinstance(values, _Array):
            raise Malformed("a chumpy object without plain values")
        return values.values(budget)


def _shape(shape: Any) -> tuple[int, ...]:
    plain = isinstance(shape, tuple) and len(shape) <= MAX_DIMENSIONS
    if not plain or not all(type(size) is int and 0 <= size < 2**48 for size in shape):
        raise Malformed("an array without a proper shape")
    return shape


def _from_bytes(raw: Any, dtype: Any, shape: Any, order: Any, budget: _Budget) -> np.ndarray:
    """An array from its bytes, whose number has to be just what dtype and shape say."""
    if not isinstance(dtype, _DType):
        raise Malformed("an array without a dtype")
    text = raw.text if isinstance(raw, _Text) else raw
    if not isinstance(text, (bytes, str)):
        raise Malformed("an array that does not come as bytes")
    resolved, sizes = dtype.resolve(), _shape(shape)
    if math.prod(sizes) * resolved.itemsize != len(text) or order not in ("C", "F"):
        raise Malformed(f"{len(text)} bytes for an array of shape {sizes}")
    budget.take(raw=len(text))
    content = text.encode("latin1") if isinstance(text, str) else text  # Python 2's bytes are read as latin1
    values = np.frombuffer(content, dtype=resolved).reshape(sizes, order=order)
    return np.array(values, dtype=resolved.newbyteorder("="), order="C")  # a copy that may be written to


def _from_buffer(raw: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> _Array:
    """``numpy._core.numeric._frombuffer``, which protocol 5 uses for contiguous arrays."""
    if axes is not None:
        raise Malformed("an array with permuted axes")
    return _Array(raw, dtype, shape, order)


def _reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
    """``numpy.core.multiarray._reconstruct``: an empty array that awaits its state."""
    if kind is not _Array:
        raise Malformed("the reconstruction of something that is no array")
    return _Array()


def _scalar(dtype: Any, raw: Any = b"") -> _Array:
    """``numpy.core.multiarray.scalar``."""
    return _from_buffer(raw, dtype, (), "C")


def _no_bytes() -> bytes:
    """``bytes()``: how Python 3 writes the content of an empty array in old protocols."""
    return b""


def _set(items: Any = ()) -> list[Any]:
    """``set`` in chumpy's bookkeeping; nothing reads it."""
    if not isinstance(items, list):
        raise Malformed("a set that is made of no list")
    return items


def _object_of(kind: Any, base: Any, state: Any) -> Any:
    """``copyreg._reconstructor``: how protocols 0 and 1 make instances of new-style classes."""
    if kind is not _Chumpy and kind not in _SPARSE.values():
        raise Malformed("an instance of an unexpected class")
    return kind.__new__(kind)


def _table() -> dict[tuple[str, str], Any]:
    table: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): _Array,
        ("numpy", "dtype"): _DType,
        ("_codecs", "encode"): Function(_Text),
        ("chumpy.ch", "Ch"): _Chumpy,
    }
    for core in ("numpy.core", "numpy._core"):
        table[f"{core}.multiarray", "_reconstruct"] = Function(_reconstruct)
        table[f"{core}.multiarray", "scalar"] = Function(_scalar)
        table[f"{core}.numeric", "_frombuffer"] = Function(_from_buffer)
    for builtins in ("__builtin__", "builtins"):
        table[builtins, "set"] = Function(_set)
        table[builtins, "bytes"] = Function(_no_bytes)
        table[builtins, "object"] = Function(_not_to_be_called)
    for registry in ("copy_reg", "copyreg"):
        table[registry, "_reconstructor"] = Function(_object_of)
    for layout, kind in _SPARSE.items():
        for module in (f"scipy.sparse.{layout}", f"scipy.sparse._{layout}"):
            table[module, f"{layout}_matrix"] = kind
            table[module, f"{layout}_array"] = kind
    return table


def _not_to_be_called(*arguments: Any) -> None:
    raise Malformed("a bare object")


def _plain(value: Any, budget: _Budget) -> Any:
    """The array behind a stand-in; anything else as it is."""
    if isinstance(value, _Array):
        return value.values(budget)
    if isinstance(value, _Instance):
        if getattr(value, "state", None) is None:
            raise Malformed("an object without state")
        return value.array(budget)
    return value


def read_pickle(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a pickled dictionary of arrays: a FLAME model or ``FLAME_masks.pkl``.

    Python-2 strings are taken as latin1; chumpy and scipy.sparse objects become dense arrays. Neither package
    is imported.

    Returns
    -------
    The dictionary: arrays (also 0-d, for numpy scalars), strings, numbers, plain containers.

    Raises
    ------
    InputError
        Where the file is missing, is no pickle of such a dictionary, is cut off, or names any global other
        than those that numpy, scipy.sparse and chumpy need for arrays. Nothing of it is run then.
    """
    path = Path(path)
    expected = "a pickled dictionary of numpy, scipy.sparse and chumpy arrays"
    content = read_bytes(path, expected, MAX_BYTES)
    try:
        return _arrays(content)
    except Refused as error:
        remedy = "The file was not read. Get the model from its official source."
        raise InputError(path, f"global {error}", expected, "a name that could run code", remedy) from error
    except Malformed as error:
        raise InputError(path, "", expected, str(error)) from error
    except Exception as error:  # a damaged stream makes the unpickler raise almost anything
        found = f"unreadable content ({type(error).__name__}: {error})"
        raise InputError(path, "", expected, found) from error


def _arrays(stream: bytes) -> dict[str, Any]:
    """What a stream holds; each stand-in is made an array once, whatever the number of its names."""
    content = ClosedUnpickler(io.BytesIO(stream), len(stream), _table()).load()
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise Malformed(f"a {type(content).__name__.lstrip('_').lower()}, not a dictionary with names")
    budget = _Budget(len(stream))
    made: dict[int, Any] = {}
    arrays = {}
    for key, value in content.items():
        if id(value) not in made:
            made[id(value)] = _plain(value, budget)
        arrays[key] = made[id(value)]
        if not isinstance(arrays[key], _DATA):
            raise Malformed(f"no data under {key!r}")
    return arrays
