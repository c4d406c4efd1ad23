"""Read the arrays in a pickle without executing anything in the file.

A pickle is a program that may call anything it can import. FLAME and its masks are Python-2 pickles with chumpy and scipy
objects, and trackers write files of ``torch.save``, so names in the stream are resolved only in a fixed table: parts of
numpy that make arrays, and stand-ins that hold what chumpy's and scipy's objects hold.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .files import open_regular, read_bytes, reading

EXPECTED = "a pickled dictionary of numpy, scipy.sparse and chumpy arrays"
REMEDY = "The file was not read. Get the model from its official source."
SAVED = "a file of torch.save with a dictionary of numpy arrays"
SAVED_REMEDY = "The file was not read. Save numpy arrays and numbers, as the tracker's own program does."

_DATA = (str, bytes, int, float, complex, type(None), list, tuple)


def read_pickle(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a pickled dictionary of arrays: a FLAME model or ``FLAME_masks.pkl``.

    Python-2 strings are decoded as latin1; chumpy and scipy.sparse objects become dense arrays.

    Returns
    -------
    dict[str, Any]
        The dictionary: arrays (also 0-d, for numpy scalars), strings, numbers, plain lists; dictionaries with text keys.

    Raises
    ------
    InputError
        The file is missing, truncated, or not a pickle of such a dictionary, or it names a global
        that NumPy, scipy.sparse and chumpy arrays do not need. Nothing in the file is executed.
    """
    path = Path(path)
    return _content(path, read_bytes(path, EXPECTED), EXPECTED, REMEDY)


def read_saved(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a dictionary of numpy arrays, possibly nested, from a file of ``torch.save``.

    The layout is the archive of PyTorch 1.6 and later. Tensors are refused, as are all objects other than NumPy arrays.
    Returns and raises as `read_pickle`.
    """
    path = Path(path)
    with open_regular(path, SAVED) as stream, reading(path, SAVED), zipfile.ZipFile(stream) as archive:
        names = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(names) != 1:
            raise InputError(path, "", "one member data.pkl", f"{len(names)}")
        content = archive.read(names[0])
    return _content(path, content, SAVED, SAVED_REMEDY)


def _content(path: Path, stream: bytes, expected: str, remedy: str) -> dict[str, Any]:
    with reading(path, expected):
        content = _plain(_Unpickler(path, stream, expected, remedy).load())
    if not isinstance(content, dict):
        raise InputError(path, "", expected, f"a {type(content).__name__}, not a dictionary with names")
    return content


def _plain(value: Any) -> Any:
    """The value with stand-ins as arrays. Raises `TypeError` for what is no data."""
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (_Chumpy, _Sparse)):
        value = value.array()
    if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "biuf":
        return np.array(value, value.dtype.newbyteorder("="), order="C")  # a writable copy
    if not isinstance(value, _DATA):
        raise TypeError(f"an entry that is a {type(value).__name__.lstrip('_').lower()}")
    return value


class _Chumpy:
    """``chumpy.ch.Ch``: a plain array under the name x. Its state becomes its attributes."""

    def array(self) -> np.ndarray:
        return np.asarray(vars(self)["x"])


class _Sparse:
    """A scipy.sparse matrix."""

    layout = ""

    def array(self) -> np.ndarray:
        """(rows, columns) array; entries at the same place add up."""
        import scipy.sparse

        own = vars(self)
        if self.layout == "coo":
            places = own.get("coords") or (own["row"], own["col"])  # since scipy 1.11, before
            parts: Any = (own["data"], places)
        else:
            parts = own["data"], own["indices"], own["indptr"]
        matrix = getattr(scipy.sparse, f"{self.layout}_matrix")(parts, own["_shape"])
        if self.layout != "coo":
            matrix.check_format(full_check=True)
        return np.asarray(matrix.toarray())


def _table() -> dict[tuple[str, str], Any]:
    """What a stream may name. Classes that a stream could alter are created for each file, so that no file affects the next."""

    def array_of(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:  # protocol 5
        return np.frombuffer(raw, dtype).reshape(shape, order=order)

    def encode(text: str, encoding: str = "") -> bytes:  # how Python 3 writes bytes in old protocols
        return text.encode("latin1")

    def object_of(kind: Any, base: Any, state: Any) -> Any:  # protocols 0 and 1
        return object.__new__(kind)

    table: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("_codecs", "encode"): encode,
        ("chumpy.ch", "Ch"): type("_Chumpy", (_Chumpy,), {}),
    }
    for core in ("numpy.core", "numpy._core"):
        table[f"{core}.multiarray", "_reconstruct"] = np.zeros(0).__reduce__()[0]
        table[f"{core}.multiarray", "scalar"] = np.float64(0).__reduce__()[0]
        table[f"{core}.numeric", "_frombuffer"] = array_of
    for builtins in ("__builtin__", "builtins"):
        table |= {(builtins, "set"): set, (builtins, "bytes"): bytes, (builtins, "object"): object}
    for registry in ("copy_reg", "copyreg"):
        table[registry, "_reconstructor"] = object_of
    for layout in ("csc", "csr", "coo"):
        kind = type(f"_{layout}_matrix", (_Sparse,), {"layout": layout})
        for module in (f"scipy.sparse.{layout}", f"scipy.sparse._{layout}"):
            table[module, f"{layout}_matrix"] = table[module, f"{layout}_array"] = kind
    return table


class _Unpickler(pickle.Unpickler):
    """Resolves names only in a fixed table."""

    def __init__(self, path: Path, stream: bytes, expected: str, remedy: str) -> None:
        super().__init__(io.BytesIO(stream), encoding="latin1")
        self._path, self._names, self._expected, self._remedy = path, _table(), expected, remedy

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._names:
            key = f"global {module}.{name}"
            raise InputError(self._path, key, self._expected, "a name that could run code", self._remedy)
        return self._names[module, name]
