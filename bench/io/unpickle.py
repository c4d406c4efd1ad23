"""Read the arrays in a pickle without executing anything in the file.

A pickle is a program that may call anything it can import. FLAME and its masks are Python-2 pickles with chumpy and scipy
objects, and trackers write files of ``torch.save``, so names in the stream are resolved only in a fixed table of stand-in
classes. A stand-in stores its arguments; arrays are created at the end, from raw bytes whose number must match their types
and shapes.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any, Self

import numpy as np

from ..errors import InputError
from .files import read_bytes, reading

EXPECTED = "a pickled dictionary of numpy, scipy.sparse and chumpy arrays"
REMEDY = "The file was not read. Get the model from its official source."
MAX_BYTES = 2**30
"""Maximum size of a file; the largest of FLAME has 0.1 GB."""
MAX_DENSE_BYTES = 40_000_000
"""Maximum entries of all dense forms of sparse matrices: a few bytes can declare any shape. A joint regressor has 200,000."""
MAX_DIMENSIONS = 8

_DATA = (np.ndarray, str, bytes, int, float, complex, type(None), list, tuple, dict)


def read_pickle(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a pickled dictionary of arrays: a FLAME model or ``FLAME_masks.pkl``.

    Python-2 strings are decoded as latin1; chumpy and scipy.sparse objects become dense arrays.

    Returns
    -------
    dict[str, Any]
        The dictionary: arrays (also 0-d, for numpy scalars), strings, numbers, plain containers.

    Raises
    ------
    InputError
        The file is missing, truncated, or not a pickle of such a dictionary, or it names a global
        that NumPy, scipy.sparse and chumpy arrays do not need. Nothing in the file is executed.
    """
    path = Path(path)
    return plain_content(path, read_bytes(path, EXPECTED, MAX_BYTES), EXPECTED, REMEDY)


def plain_content(path: Path, stream: bytes, expected: str, remedy: str, levels: int = 1) -> dict[str, Any]:
    """The dictionary in the bytes of a pickle, as `read_pickle` returns it, with up to ``levels`` nested levels.

    Raises `InputError` as `read_pickle` does, with ``path``, ``expected`` (the kind of file) and ``remedy``.
    """
    with reading(path, expected):
        content = _ClosedUnpickler(path, stream, expected, remedy).load()
        return _Arrays(len(stream) + MAX_DENSE_BYTES).plain(content, levels)


class _Arrays:
    """Converts stand-ins to arrays, each once even if shared, with at most ``left`` bytes in total."""

    def __init__(self, left: int) -> None:
        self._left = left
        self._made: dict[int, Any] = {}

    def plain(self, content: Any, levels: int) -> dict[str, Any]:
        """Convert the stand-ins in a dictionary to arrays, including nested dictionaries up to ``levels`` deep."""
        if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
            raise ValueError(f"a {type(content).__name__.lstrip('_').lower()}, not a dictionary with names")
        for value in content.values():
            if id(value) not in self._made:
                self._made[id(value)] = self._value(value, levels)
        return {key: self._made[id(value)] for key, value in content.items()}

    def _value(self, value: Any, levels: int) -> Any:
        if isinstance(value, dict) and levels > 1 and all(isinstance(key, str) for key in value):
            return self.plain(value, levels - 1)
        made = value.array() if isinstance(value, _StandIn) else value
        self._left -= getattr(made, "nbytes", 0)
        if self._left < 0 or not isinstance(made, _DATA):
            raise ValueError(
                "arrays of more bytes than the file has" if self._left < 0 else "an entry of no data"
            )
        return made


class _StandIn:
    """An object in the stream: its arguments and its state."""

    arguments: tuple[Any, ...]
    state: Any

    def __new__(cls, *arguments: Any) -> Self:
        made = super().__new__(cls)
        made.arguments, made.state = arguments, None
        return made

    def __setstate__(self, state: Any) -> None:
        self.state = state

    @property
    def fields(self) -> dict[str, Any]:
        """The instance dictionary, which Python may wrap in a pair with the slots' state."""
        pair = isinstance(self.state, tuple) and len(self.state) == 2
        return self.state[0] if pair else self.state

    def array(self) -> np.ndarray:
        """The values."""
        raise ValueError(f"an array that is a {type(self).__name__.lstrip('_').lower()}")


class _DType(_StandIn):
    """``numpy.dtype(name, align, copy)`` with its state (version, byte order, sub-array, names, fields, ...)."""

    def resolve(self) -> np.dtype[Any]:
        """The numpy dtype: truth values, integers and floats only."""
        name, state = self.arguments[0], self.state or (3, "=", None, None, None)
        if not re.fullmatch("b1|[iu][1248]|f[248]", name) or any(part is not None for part in state[2:5]):
            raise ValueError(f"an array of dtype {name[:20]!r}")
        return np.dtype(name).newbyteorder(state[1])


class _Array(_StandIn):
    """``numpy.core.multiarray._reconstruct`` with its state (version, shape, dtype, fortran, bytes)."""

    def array(self) -> np.ndarray:
        _, shape, dtype, fortran, raw = self.state
        return _from_bytes(raw, dtype, shape, "F" if fortran else "C")


class _Buffer(_StandIn):
    """``numpy._core.numeric._frombuffer``, which protocol 5 uses for contiguous arrays."""

    def array(self) -> np.ndarray:
        raw, dtype, shape, order = self.arguments
        return _from_bytes(raw, dtype, shape, order)


class _Scalar(_StandIn):
    """``numpy.core.multiarray.scalar``."""

    def array(self) -> np.ndarray:
        dtype, raw = self.arguments
        return _from_bytes(raw, dtype, (), "C")


class _Chumpy(_StandIn):
    """``chumpy.ch.Ch``: a plain array under the key x."""

    def array(self) -> np.ndarray:
        values: np.ndarray = self.fields["x"].array()
        return values


class _Sparse(_StandIn):
    """A scipy.sparse matrix."""

    layout = ""

    def array(self) -> np.ndarray:
        """(rows, columns) array; entries at the same place add up."""
        import scipy.sparse

        fields, shape = self.fields, self.fields["_shape"]
        if len(shape) != 2 or math.prod(shape) * 8 > MAX_DENSE_BYTES:
            raise ValueError(f"a sparse matrix of shape {shape}")
        if self.layout == "coo":
            rows, columns = fields.get("coords") or (fields["row"], fields["col"])  # since scipy 1.11, before
            parts: Any = (fields["data"].array(), (rows.array(), columns.array()))
        else:
            parts = tuple(fields[name].array() for name in ("data", "indices", "indptr"))
        matrix = getattr(scipy.sparse, f"{self.layout}_matrix")(parts, shape)
        if self.layout != "coo":
            matrix.check_format(full_check=True)
        dense: np.ndarray = matrix.toarray()
        return dense


def _from_bytes(raw: Any, dtype: _DType, shape: tuple[int, ...], order: Any) -> np.ndarray:
    """An array from its bytes, whose number must match dtype and shape exactly."""
    content = raw.encode("latin1") if isinstance(raw, str) else raw  # bytes of Python 2 are decoded as latin1
    values = np.frombuffer(content, dtype.resolve())
    if len(shape) > MAX_DIMENSIONS or math.prod(shape) != values.size:
        raise ValueError(f"{len(content)} bytes for an array of shape {shape}")
    # A writable copy.
    return np.array(values.reshape(shape, order=order), dtype=values.dtype.newbyteorder("="), order="C")


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """``_codecs.encode``: bytes as Python 3 writes them in old protocols."""
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """``bytes()``: how Python 3 writes the content of an empty array in old protocols."""
    return b""


def _set(items: list[Any]) -> list[Any]:
    """``set`` in chumpy's bookkeeping; nothing reads it."""
    return items


def _object_of(kind: type[_StandIn], base: Any, state: Any) -> _StandIn:
    """``copyreg._reconstructor``: how protocols 0 and 1 make instances of new-style classes."""
    return kind.__new__(kind)


def _table() -> dict[tuple[str, str], Any]:
    table: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): _Array,
        ("numpy", "dtype"): _DType,
        ("_codecs", "encode"): _encode,
        ("chumpy.ch", "Ch"): _Chumpy,
    }
    for core in ("numpy.core", "numpy._core"):
        table[f"{core}.multiarray", "_reconstruct"] = _Array
        table[f"{core}.multiarray", "scalar"] = _Scalar
        table[f"{core}.numeric", "_frombuffer"] = _Buffer
    for builtins in ("__builtin__", "builtins"):
        table |= {(builtins, "set"): _set, (builtins, "bytes"): _no_bytes, (builtins, "object"): None}
    for registry in ("copy_reg", "copyreg"):
        table[registry, "_reconstructor"] = _object_of
    for layout in ("csc", "csr", "coo"):
        kind = type(f"_{layout}_matrix", (_Sparse,), {"layout": layout})
        for module in (f"scipy.sparse.{layout}", f"scipy.sparse._{layout}"):
            table[module, f"{layout}_matrix"] = table[module, f"{layout}_array"] = kind
    return table


def _load_state(unpickler: Any) -> None:
    """Set the state of a stand-in. A class or function is refused, because it would keep the state for the
    next file."""
    if not isinstance(unpickler.stack[-2], _StandIn):
        raise pickle.UnpicklingError("a state for something that has none")
    _PythonUnpickler.load_build(unpickler)


def _load_bytes(unpickler: Any) -> None:
    """A bytearray; Python would allocate the declared length before reading."""
    (size,) = struct.unpack("<Q", unpickler.read(8))
    unpickler.append(unpickler.read(size))


def _with_plain_keys(load: Callable[[Any], None], keys: slice) -> Callable[[Any], None]:
    """Add entries to dictionaries, with only text and numbers as keys: hashing nested tuples can take forever."""

    def checked(unpickler: Any) -> None:
        for key in unpickler.stack[keys]:
            long = isinstance(key, int) and abs(key) >= 2**63
            if long or not isinstance(key, (str, bytes, float, int, type(None))):
                raise pickle.UnpicklingError("a key that is neither text nor a number")
        load(unpickler)

    return checked


def _refuse(unpickler: Any) -> None:
    raise pickle.UnpicklingError("an operation that files of FLAME do not need")


# The Python unpickler: the C version allocates any memo size that the stream declares, so that nine bytes can
# allocate gigabytes. Arrays are single operations, so this is not slower.
_PythonUnpickler: Any = vars(pickle)["_Unpickler"]
_OPERATIONS: dict[int, Callable[[Any], None]] = {
    **_PythonUnpickler.dispatch,
    pickle.BUILD[0]: _load_state,
    pickle.BYTEARRAY8[0]: _load_bytes,
    pickle.SETITEM[0]: _with_plain_keys(_PythonUnpickler.load_setitem, slice(-2, -1)),
    pickle.SETITEMS[0]: _with_plain_keys(_PythonUnpickler.load_setitems, slice(0, None, 2)),
    pickle.DICT[0]: _with_plain_keys(_PythonUnpickler.load_dict, slice(0, None, 2)),
    **dict.fromkeys((pickle.EXT1[0], pickle.EXT2[0], pickle.EXT4[0]), _refuse),
    pickle.EMPTY_SET[0]: _PythonUnpickler.load_empty_list,  # a set would hash its members; sets are not used
    pickle.ADDITEMS[0]: _PythonUnpickler.load_appends,
    pickle.FROZENSET[0]: _PythonUnpickler.load_list,
}


class _ClosedUnpickler(_PythonUnpickler):
    """Resolves names only in a fixed table."""

    dispatch = _OPERATIONS

    def __init__(self, path: Path, stream: bytes, expected: str, remedy: str) -> None:
        super().__init__(io.BytesIO(stream), encoding="latin1")
        self._path, self._names = path, _table()
        self._expected, self._remedy = expected, remedy

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._names:
            key = f"global {module}.{name}"
            raise InputError(self._path, key, self._expected, "a name that could run code", self._remedy)
        return self._names[module, name]
