"""Reads arrays of npz and npy files, and checks their types, shapes and values before use."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from ..errors import InputError
from .files import atomic_path, open_regular, reading

MAX_MAGNITUDE = 1e4
"""Largest magnitude of a number in a head model or its tracking: metres, radians, coefficients."""

_MARK = "mark"
_log = logging.getLogger(__name__)
_KINDS = "biufU"


@dataclass(frozen=True)
class Member:
    """Requirements of an array.

    Attributes
    ----------
    kinds : str
        Letters of NumPy type kinds; "U" is text.
    shape : tuple[int | str | None, ...] | None
        For each axis its size, a name for a size that is shared, or None for any size; None allows
        any shape.
    most : float | None
        Largest magnitude. Floating-point numbers must be finite in any case.
    least : float | None
        Smallest number; ``-most`` by default.
    dtype : str
        Required type; "" allows any type of ``kinds``.
    optional : bool
        Whether the file may lack the member.
    """

    kinds: str = "f"
    shape: tuple[int | str | None, ...] | None = None
    most: float | None = None
    dtype: str = ""
    optional: bool = False
    least: float | None = None


TEXT = Member("U", ())
"""A single text."""


def read_arrays(
    path: Path, members: Mapping[str, Member], sizes: Mapping[str, int] | None = None
) -> dict[str, np.ndarray]:
    """Read an npz and check the described members; others are returned unchecked.

    ``sizes`` gives sizes of the axes named in ``members``. Raises `InputError` as `read_npz` does, and for
    the first member that is missing or not as described.
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
    """Check arrays by name; return the sizes of the named axes. Raises `InputError` as `read_arrays` does."""
    known = dict(sizes or {})
    for name, member in members.items():
        if name in content:
            _check(path, name, content[name], member, known)
        elif not member.optional:
            found = f"only {', '.join(sorted(content))}"[:400]
            raise InputError(path, name, "an array of that name", found)
    return known


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
            for size, found in zip(member.shape, values.shape):
                fits = fits and (not isinstance(size, str) or sizes.setdefault(size, found) == found)
        if not fits:
            named = [str(w if w is not None else s or "any") for w, s in zip(wanted, member.shape)]
            comma = "," * (len(named) == 1)
            raise InputError(path, name, f"shape ({', '.join(named)}{comma})", f"shape {values.shape}")
    if values.dtype.kind in "fiu":
        check_numbers(path, name, values, member.most, member.least)


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read every member of an npz: numbers, truth values and text in the machine's byte order.

    Nothing is unpickled. Raises `InputError` for a file that is missing, damaged, or not an npz of such arrays.
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
