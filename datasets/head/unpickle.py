"""Read the arrays in a FLAME pickle without running anything the file asks for.

A pickle is a program that may call whatever it can import. FLAME and its masks come as Python-2 pickles full
of chumpy and scipy objects, so they cannot be turned down; instead every name in the stream is looked up in a
closed table of stand-ins. A stand-in only keeps the state it is given; arrays are then built here from raw
bytes, after their declared types and sizes have been checked against those bytes. No class or function of
numpy, scipy or chumpy is ever handed to the stream, and no other name is resolved.
"""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Self, cast

import numpy as np

from ...bench.errors import InputError

MAX_DENSE_ELEMENTS = 50_000_000
"""Sparse matrices above this many elements are refused: a few bytes can declare any shape."""

_KINDS = {"f", "i", "u", "b"}
_DATA = (np.ndarray, str, bytes, int, float, complex, type(None), list, tuple, dict)
_ByteOrder = Literal["<", ">", "|", "="]


class _Refused(Exception):
    """The stream named a global that is not in the table."""


class _Malformed(Exception):
    """The stream used a stand-in in a way no genuine pickle does."""


class _Function:
    """A callable the stream may use, which it cannot alter: the state of a function is never restored."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        self._call = call

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise _Malformed("an attempt to alter a function")


class _DType:
    """``numpy.dtype(name, align, copy)`` and its state (version, byte order, sub-array, names, fields, ...)."""

    __slots__ = ("name", "order")

    def __init__(self, name: Any, align: Any = False, copy: Any = False) -> None:
        if not isinstance(name, str):
            raise _Malformed("a dtype without a name")
        self.name = name
        self.order: _ByteOrder = "="

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or any(part is not None for part in state[2:5]):
            raise _Malformed("a structured or malformed dtype")
        if state[1] not in ("<", ">", "|", "="):
            raise _Malformed("a dtype without a byte order")
        self.order = cast(_ByteOrder, state[1])

    def resolve(self) -> np.dtype[Any]:
        """The numpy dtype: booleans, integers and floats only."""
        known = len(self.name) <= 3 and self.name[:1] in _KINDS and self.name[1:].isdecimal()
        if not known:
            raise _Malformed(f"an array of dtype {self.name[:20]!r}")
        try:
            return np.dtype(self.name).newbyteorder(self.order)
        except TypeError as error:
            raise _Malformed(f"an array of dtype {self.name!r}") from error


class _Array:
    """``numpy.ndarray`` between its reconstruction and its state (version, shape, dtype, fortran, bytes)."""

    __slots__ = ("values",)

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise _Malformed("an array with an unknown kind of state")
        _, shape, dtype, fortran, raw = state
        self.values = _from_bytes(raw, dtype, shape, "F" if fortran else "C")


class _Sparse:
    """A scipy.sparse matrix: its instance dictionary, made dense once everything is read."""

    __slots__ = ("state",)
    layout = ""

    def __new__(cls, *arguments: Any) -> Self:
        return super().__new__(cls)

    def __setstate__(self, state: Any) -> None:
        self.state = _dictionary(state)

    def dense(self) -> np.ndarray:
        """(rows, columns) array; entries at the same place add up, as in scipy."""
        shape = _shape(self.state.get("_shape"))
        if len(shape) != 2 or math.prod(shape) > MAX_DENSE_ELEMENTS:
            raise _Malformed(f"a sparse matrix of shape {shape}")
        data = self._part("data", _KINDS)
        rows, columns = self._coordinates(shape)
        if not len(rows) == len(columns) == len(data):
            raise _Malformed("a sparse matrix whose parts differ in length")
        for indices, size in ((rows, shape[0]), (columns, shape[1])):
            if indices.size and not (0 <= indices.min() and indices.max() < size):
                raise _Malformed("a sparse matrix with indices out of range")
        matrix = np.zeros(shape, dtype=data.dtype)
        np.add.at(matrix, (rows, columns), data)
        return matrix

    def _coordinates(self, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        if self.layout == "coo":
            coords = self.state.get("coords")
            if isinstance(coords, tuple) and len(coords) == 2:
                row, column = (_plain(part) for part in coords)
                if not all(
                    isinstance(part, np.ndarray) and part.dtype.kind in "iu" for part in (row, column)
                ):
                    raise _Malformed("a sparse matrix without coordinates")
                return row.ravel(), column.ravel()
            return self._part("row", {"i", "u"}), self._part("col", {"i", "u"})
        minor = self._part("indices", {"i", "u"})
        pointers = self._part("indptr", {"i", "u"}).astype(np.int64)
        lines = shape[1] if self.layout == "csc" else shape[0]
        counts = np.diff(pointers)
        if len(pointers) != lines + 1 or pointers[0] != 0 or (counts < 0).any() or pointers[-1] != len(minor):
            raise _Malformed("a sparse matrix with broken row or column pointers")
        major = np.repeat(np.arange(lines), counts)
        return (minor, major) if self.layout == "csc" else (major, minor)

    def _part(self, name: str, kinds: set[str]) -> np.ndarray:
        values = _plain(self.state.get(name))
        if not isinstance(values, np.ndarray) or values.dtype.kind not in kinds:
            raise _Malformed(f"a sparse matrix without {name}")
        return values.ravel()


class _SparseColumns(_Sparse):
    __slots__ = ()
    layout = "csc"


class _SparseRows(_Sparse):
    __slots__ = ()
    layout = "csr"


class _SparseCoordinates(_Sparse):
    __slots__ = ()
    layout = "coo"


class _Chumpy:
    """``chumpy.ch.Ch``: a plain array under the key x of its instance dictionary."""

    __slots__ = ("state",)

    def __new__(cls, *arguments: Any) -> Self:
        return super().__new__(cls)

    def __setstate__(self, state: Any) -> None:
        self.state = _dictionary(state)

    def array(self) -> np.ndarray:
        """The wrapped values."""
        values = self.state.get("x")
        if not isinstance(values, _Array):
            raise _Malformed("a chumpy object without plain values")
        return _plain(values)


def _dictionary(state: Any) -> dict[Any, Any]:
    """Instance dictionary of a pickled object; Python may wrap it in a pair with the slots' state."""
    if isinstance(state, tuple) and len(state) == 2 and not state[1]:
        state = state[0]
    if not isinstance(state, dict):
        raise _Malformed("an object whose state is no dictionary")
    return state


def _shape(shape: Any) -> tuple[int, ...]:
    if not isinstance(shape, tuple) or not all(type(size) is int and size >= 0 for size in shape):
        raise _Malformed("an array without a proper shape")
    return shape


def _from_bytes(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    """An array from its bytes, whose number has to be just what dtype and shape say."""
    if not isinstance(dtype, _DType):
        raise _Malformed("an array without a dtype")
    if isinstance(raw, str):  # a Python-2 string, read as latin1
        raw = raw.encode("latin1")
    if not isinstance(raw, (bytes, bytearray)):
        raise _Malformed("an array that does not come as bytes")
    resolved, sizes = dtype.resolve(), _shape(shape)
    if math.prod(sizes) * resolved.itemsize != len(raw) or order not in ("C", "F"):
        raise _Malformed(f"{len(raw)} bytes for an array of shape {sizes}")
    values = np.frombuffer(raw, dtype=resolved).reshape(sizes, order=order)
    return np.ascontiguousarray(values, dtype=resolved.newbyteorder("="))


def _from_buffer(raw: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> _Array:
    """``numpy._core.numeric._frombuffer``, which protocol 5 uses for contiguous arrays."""
    if axes is not None:
        raise _Malformed("an array with permuted axes")
    array = _Array()
    array.values = _from_bytes(raw, dtype, shape, order)
    return array


def _reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
    """``numpy.core.multiarray._reconstruct``: an empty array that awaits its state."""
    if kind is not _Array:
        raise _Malformed("the reconstruction of something that is no array")
    return _Array()


def _scalar(dtype: Any, raw: Any = b"") -> _Array:
    """``numpy.core.multiarray.scalar``."""
    return _from_buffer(raw, dtype, (), "C")


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    """``_codecs.encode``: how Python 3 writes bytes in old protocols."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise _Malformed("text in an unexpected encoding")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """``bytes()``: how Python 3 writes the content of an empty array in old protocols."""
    return b""


def _set(items: Any = ()) -> list[Any]:
    """``set`` in chumpy's bookkeeping; nothing reads it."""
    if not isinstance(items, list):
        raise _Malformed("a set that is made of no list")
    return items


def _object_of(kind: Any, base: Any, state: Any) -> Any:
    """``copyreg._reconstructor``: how protocols 0 and 1 make instances of new-style classes."""
    if kind not in _CLASSES:
        raise _Malformed("an instance of an unexpected class")
    return kind.__new__(kind)


_CLASSES: tuple[type, ...] = (_Chumpy, _SparseColumns, _SparseRows, _SparseCoordinates)


def _table() -> dict[tuple[str, str], Any]:
    table: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): _Array,
        ("numpy", "dtype"): _DType,
        ("_codecs", "encode"): _Function(_encode),
        ("chumpy.ch", "Ch"): _Chumpy,
    }
    for core in ("numpy.core", "numpy._core"):
        table[f"{core}.multiarray", "_reconstruct"] = _Function(_reconstruct)
        table[f"{core}.multiarray", "scalar"] = _Function(_scalar)
        table[f"{core}.numeric", "_frombuffer"] = _Function(_from_buffer)
    for builtins in ("__builtin__", "builtins"):
        table[builtins, "set"] = _Function(_set)
        table[builtins, "bytes"] = _Function(_no_bytes)
        table[builtins, "object"] = _Function(_not_to_be_called)
    for registry in ("copy_reg", "copyreg"):
        table[registry, "_reconstructor"] = _Function(_object_of)
    for kind in _CLASSES[1:]:
        layout = kind.layout  # type: ignore[attr-defined]
        for module in (f"scipy.sparse.{layout}", f"scipy.sparse._{layout}"):
            table[module, f"{layout}_matrix"] = kind
            table[module, f"{layout}_array"] = kind
    return table


def _not_to_be_called(*arguments: Any) -> None:
    raise _Malformed("a bare object")


# The unpickler written in Python: the one in C allocates whatever memo size the stream names, so that nine
# bytes can ask for gigabytes. Arrays are single opcodes, hence nothing is lost in speed.
_PythonUnpickler: Any = vars(pickle)["_Unpickler"]


class _RestrictedUnpickler(_PythonUnpickler):
    """Resolves names in the closed table and nowhere else."""

    def __init__(self, content: bytes) -> None:
        super().__init__(io.BytesIO(content), encoding="latin1")
        self._table = _table()

    def find_class(self, module: str, name: str) -> Any:
        try:
            return self._table[module, name]
        except KeyError:
            raise _Refused(f"{module}.{name}") from None


def _plain(value: Any) -> Any:
    """The array behind a stand-in; anything else as it is."""
    if isinstance(value, _Array):
        values = getattr(value, "values", None)
        if values is None:
            raise _Malformed("an array without content")
        return values
    if isinstance(value, (_Sparse, _Chumpy)):
        if getattr(value, "state", None) is None:
            raise _Malformed("an object without state")
        return value.dense() if isinstance(value, _Sparse) else value.array()
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
    try:
        content = _RestrictedUnpickler(path.read_bytes()).load()
        if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
            raise _Malformed(f"a {type(content).__name__.lstrip('_').lower()}, not a dictionary with names")
        arrays = {key: _plain(value) for key, value in content.items()}
        for key, value in arrays.items():
            if not isinstance(value, _DATA):
                raise _Malformed(f"no data under {key!r}")
        return arrays
    except FileNotFoundError as error:
        raise InputError(path, "", "a file", "none") from error
    except _Refused as error:
        raise InputError(
            path,
            f"global {error}",
            expected,
            "a name that could run code",
            "The file was not read. Get the model from its official source.",
        ) from error
    except _Malformed as error:
        raise InputError(path, "", expected, str(error)) from error
    except Exception as error:  # a damaged stream makes the unpickler raise almost anything
        raise InputError(
            path, "", expected, f"unreadable content ({type(error).__name__}: {error})"
        ) from error
