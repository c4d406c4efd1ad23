"""Reads arrays of npz and npy files, and checks their types, shapes and values before use."""

from __future__ import annotations

import io
import logging
import pickle
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .files import atomic_path, open_regular, read_bytes, reading

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
        content = _plain_tree(_Unpickler(path, stream, expected, remedy).load())
    if not isinstance(content, dict):
        raise InputError(path, "", expected, f"a {type(content).__name__}, not a dictionary with names")
    return content


def _plain_tree(value: Any) -> Any:
    """The value with stand-ins as arrays. Raises `TypeError` for what is no data."""
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: _plain_tree(part) for key, part in value.items()}
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

        arrays = vars(self)
        if self.layout == "coo":
            places = arrays.get("coords") or (arrays["row"], arrays["col"])  # since scipy 1.11, before
            parts: Any = (arrays["data"], places)
        else:
            parts = arrays["data"], arrays["indices"], arrays["indptr"]
        matrix = getattr(scipy.sparse, f"{self.layout}_matrix")(parts, arrays["_shape"])
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


MAX_MAGNITUDE = 1e4
"""Largest magnitude of a number in a head model or its tracking: metres, radians, coefficients."""

_MARK = "mark"
_log = logging.getLogger(__name__)
_KINDS = "biufU"


@dataclass(frozen=True)
class Member:
    """Requirements of an array."""

    kinds: str = "f"
    """Letters of NumPy type kinds; "U" is text."""
    shape: tuple[int | str | None, ...] | None = None
    """For each axis its size, a name for a size that is shared, or None for any size; None allows any shape."""
    most: float | None = None
    """Largest magnitude. Floating-point numbers must be finite in any case."""
    dtype: str = ""
    """Required type; "" allows any type of ``kinds``."""
    optional: bool = False
    """Whether the file may lack the member."""
    least: float | None = None
    """Smallest number; ``-most`` by default."""


TEXT = Member("U", ())
"""A single text."""


def read_arrays(
    path: Path, members: Mapping[str, Member], sizes: Mapping[str, int] | None = None
) -> dict[str, np.ndarray]:
    """Read an npz and check the described members; others are returned unchecked.

    ``sizes`` gives sizes of the axes named in ``members``.
    """
    content = read_npz(path)
    check_arrays(path, content, members, sizes)
    return content


def cached_arrays(
    path: Path,
    mark: str,
    members: Mapping[str, Member],
    make: Callable[[], Mapping[str, np.ndarray]],
    sizes: Mapping[str, int] | None = None,
) -> dict[str, np.ndarray]:
    """Return cached arrays with the same ``mark``, or store and return those of ``make``.

    Parameters
    ----------
    mark : str
        Digest of everything that the arrays depend on.
    members, sizes : Mapping
        As for `read_arrays`. An invalid file is made again.
    """
    kept = stored_arrays(path, mark, members, sizes)
    if kept is None:
        kept = dict(make())
        store_arrays(path, mark, kept)
    return kept


def stored_arrays(
    path: Path, mark: str, members: Mapping[str, Member], sizes: Mapping[str, int] | None = None
) -> dict[str, np.ndarray] | None:
    """The arrays that `store_arrays` wrote with the same ``mark``; None if there are none or they cannot be read."""
    if path.exists():
        try:
            kept = read_arrays(path, {_MARK: TEXT, **members}, sizes)
            if str(kept.pop(_MARK)) == mark:
                return kept
        except InputError as error:
            _log.warning("made again: %s", error)
    return None


def store_arrays(path: Path, mark: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays and their ``mark`` atomically as an npz."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **{_MARK: np.array(mark)}, **arrays)


def check_arrays(
    path: str | PathLike[str],
    content: Mapping[str, np.ndarray],
    members: Mapping[str, Member],
    sizes: Mapping[str, int] | None = None,
) -> dict[str, int]:
    """Check arrays by name; return the sizes of the named axes."""
    lengths = dict(sizes or {})
    for name, member in members.items():
        if name in content:
            _check(path, name, content[name], member, lengths)
        elif not member.optional:
            found = f"only {', '.join(sorted(content))}"[:400]
            raise InputError(path, name, "an array of that name", found)
    return lengths


def check_numbers(
    path: str | PathLike[str],
    name: str,
    values: np.ndarray,
    most: float | None = None,
    least: float | None = None,
) -> None:
    """Raise `InputError` for a number that is not finite, or larger than ``most`` in magnitude, or smaller than ``least``."""
    if values.dtype.kind == "f":
        broken = int(values.size - np.count_nonzero(np.isfinite(values)))
        if broken:
            raise InputError(path, name, "finite numbers", f"{broken} that are NaN or infinite")
    if most is not None and values.size:
        lowest, highest = float(values.min()), float(values.max())
        if least is not None and not least <= lowest <= highest <= most:
            worst = lowest if lowest < least else highest
            raise InputError(path, name, f"numbers from {least:g} to {most:g}", f"{worst:g}")
        if least is None and max(highest, -lowest) > most:
            found = f"one of size {max(highest, -lowest):g}"
            raise InputError(path, name, f"numbers from {-most:g} to {most:g}", found)


def _check(
    path: str | PathLike[str], name: str, values: np.ndarray, member: Member, sizes: dict[str, int]
) -> None:
    if values.dtype.kind not in member.kinds or (member.dtype and values.dtype != np.dtype(member.dtype)):
        kinds = {"f": "floating-point numbers", "iu": "integers", "fiu": "numbers", "U": "text"}
        expected = member.dtype or kinds.get(member.kinds, f"numpy's kinds {member.kinds}")
        raise InputError(path, name, expected, f"dtype {values.dtype}")
    if member.shape is not None:
        wanted = [sizes.get(size) if isinstance(size, str) else size for size in member.shape]
        fits = len(wanted) == values.ndim and all(w in (None, n) for w, n in zip(wanted, values.shape))
        if fits:
            for size, length in zip(member.shape, values.shape):
                fits = fits and (not isinstance(size, str) or sizes.setdefault(size, length) == length)
        if not fits:
            named = [str(w if w is not None else s or "any") for w, s in zip(wanted, member.shape)]
            comma = "," * (len(named) == 1)
            raise InputError(path, name, f"shape ({', '.join(named)}{comma})", f"shape {values.shape}")
    if values.dtype.kind in "fiu":
        check_numbers(path, name, values, member.most, member.least)


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read every member of an npz: numbers, truth values and text in the machine's byte order.

    Nothing is unpickled.
    """
    expected = "an npz file of plain arrays"
    with open_regular(path, expected) as stream, reading(path, expected):
        archive = np.lib.npyio.NpzFile(stream, allow_pickle=False)
        return {name: _plain(path, name, archive[name]) for name in archive.files}


def read_npy(path: Path) -> np.ndarray:
    """Read the array of an npy file, as `read_npz` reads its members; raises `InputError` as it does."""
    expected = "an npy file of a plain array"
    with open_regular(path, expected) as stream, reading(path, expected):
        return _plain(path, "", np.load(stream, allow_pickle=False))


def _plain(path: Path, name: str, values: object) -> np.ndarray:
    if not isinstance(values, np.ndarray) or values.dtype.kind not in _KINDS:
        found = f"dtype {values.dtype}" if isinstance(values, np.ndarray) else "another kind of file"
        raise InputError(path, name, "an array of numbers or text", found)
    return values.astype(values.dtype.newbyteorder("="), copy=False)
