"""Tables of values over time: CSV, JSON, JSON lines, npz, and folders with one file per frame."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, check_numbers, read_npy, read_npz
from ...bench.io.documents import parse_json, read_json, read_text, shown
from ...bench.io.files import reading, user_files
from .names import IDENTITY, NAMES

_CATEGORY_NAMES, _SCORE = ("categoryName", "category_name"), "score"
"""Keys of MediaPipe's categories in its JavaScript and its Python."""

_FRAMES = "frames"
"""Key of a JSON document with a list of frames."""


@dataclass(frozen=True, eq=False)
class SignalTable:
    """Columns of a signal, not yet checked: each is converted when it is used.

    Attributes
    ----------
    path : Path
        File or folder, named in errors.
    columns : Mapping[str, Sequence[Any] | np.ndarray]
        T values by name: numbers, text, lists of numbers, or an array (T, ...).
    places : Sequence[str]
        Location of each of the T frames in the file, such as "line 7".
    """

    path: Path
    columns: Mapping[str, Sequence[Any] | np.ndarray]
    places: Sequence[str]

    def __len__(self) -> int:
        return len(self.places)

    def values(self, name: str) -> FloatArray:
        """(T, n) float64 values of a column; n is 1 for single numbers.

        Raises `InputError` for values that are not finite numbers within `MAX_MAGNITUDE`, and for frames of unequal length.
        """
        column = self.columns[name]
        if len(column) != len(self):
            raise InputError(self.path, name, f"{len(self)} frames, as other columns have", str(len(column)))
        if isinstance(column, np.ndarray):
            if column.dtype.kind not in "fiu":
                raise InputError(self.path, name, "numbers", f"dtype {column.dtype}")
            values = column.reshape(len(self), math.prod(column.shape[1:])).astype(np.float64)
        else:
            rows = [self._row(name, place, value) for place, value in zip(self.places, column)]
            for place, row in zip(self.places, rows):
                if len(row) != len(rows[0]):
                    key = f"{name}, {place}"
                    raise InputError(self.path, key, f"{len(rows[0])} numbers, as before", str(len(row)))
            values = np.array(rows, np.float64)
        check_numbers(self.path, name, values, MAX_MAGNITUDE)
        return values

    def single(self, name: str) -> FloatArray:
        """(T,) values of a column with one number a frame. Raises `InputError` for more, and as `values`."""
        found = self.values(name)
        if found.shape[1] != 1:
            raise InputError(self.path, name, "one number a frame", str(found.shape[1]))
        return found[:, 0]

    def _row(self, name: str, place: str, value: Any) -> FloatArray | list[float]:
        if isinstance(value, np.ndarray):
            if value.dtype.kind not in "fiu":
                raise InputError(self.path, f"{name}, {place}", "numbers", f"dtype {value.dtype}")
            return value.ravel()
        inner = value
        while isinstance(inner, list) and len(inner) == 1 and isinstance(inner[0], list):
            inner = inner[0]
        try:
            items = inner if isinstance(inner, list) else [inner]
            if any(isinstance(item, (bool, list, dict, type(None))) for item in items):
                raise ValueError
            if not items:
                raise ValueError
            return [float(item) for item in items]
        except (ValueError, OverflowError):
            expected = "a number" if isinstance(value, str) else "a number or a list of numbers"
            raise InputError(self.path, f"{name}, {place}", expected, shown(value)) from None


def read_table(path: Path) -> SignalTable:
    """Read a file by its ending, or a folder with files of each frame.

    Raises `InputError` for another ending, a damaged or empty file, and frames with unequal columns.
    """
    if path.is_dir():
        return _folder(path)
    read = _READERS.get(path.suffix.lower())
    if read is None:
        expected = f"a file in {', '.join(_READERS)}, or a folder"
        remedy = "" if path.exists() else "There is no such file."
        raise InputError(path, "", expected, repr(path.suffix), remedy)
    table = read(path)
    if not len(table) or not table.columns:
        raise InputError(path, "", "at least one frame with values", "none")
    return table


def parse_line(text: str, path: Path, place: str) -> dict[str, Any]:
    """Columns of one line of JSON; MediaPipe's lists of categories become one column each."""
    return _expanded(parse_json(text, path, place))


def _expanded(frame: Mapping[str, Any]) -> dict[str, Any]:
    """Columns of a frame, with one for each of MediaPipe's categories."""
    line: dict[str, Any] = {}
    for name, value in frame.items():
        categories = _categories(value)
        line |= {name: value} if categories is None else categories
    return line


def _categories(value: Any) -> dict[str, Any] | None:
    """Scores by name, if the value is MediaPipe's list of categories, of one face or a list with one face."""
    while isinstance(value, list) and len(value) == 1 and isinstance(value[0], list):
        value = value[0]
    if not isinstance(value, list) or not value or not all(isinstance(item, dict) for item in value):
        return None
    found = {}
    for item in value:
        names = [item[key] for key in _CATEGORY_NAMES if isinstance(item.get(key), str)]
        if not names or _SCORE not in item:
            return None
        found[names[0]] = item[_SCORE]
    return found


def _csv(path: Path) -> SignalTable:
    text = read_text(path, "CSV")
    with reading(path, "a CSV file"):
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    if not rows:
        raise InputError(path, "", "a header and a line for each frame", "an empty file")
    names = [name.strip() for name in rows[0][1]]
    for name in names:
        if not name or names.count(name) > 1:
            raise InputError(path, "header", "distinct names of columns", repr(name))
    for number, row in rows[1:]:
        if len(row) != len(names):
            expected = f"{len(names)} values, as the header has names"
            raise InputError(path, f"line {number}", expected, str(len(row)))
    columns = {name: [row[index] for _, row in rows[1:]] for index, name in enumerate(names)}
    return SignalTable(path, columns, [f"line {number}" for number, _ in rows[1:]])


def _json_lines(path: Path) -> SignalTable:
    lines = read_text(path, "JSON lines").splitlines()
    places = [f"line {number}" for number, line in enumerate(lines, 1) if line.strip()]
    return _joined(
        path, places, [parse_line(line, path, f"line {n}") for n, line in enumerate(lines, 1) if line.strip()]
    )


def _json(path: Path) -> SignalTable:
    document = read_json(path)
    frames = document.get(_FRAMES)
    if isinstance(frames, list):
        for number, frame in enumerate(frames):
            if not isinstance(frame, dict):
                raise InputError(path, f"{_FRAMES}[{number}]", "an object", shown(frame))
        places = [f"{_FRAMES}[{number}]" for number in range(len(frames))]
        return _joined(path, places, [_expanded(frame) for frame in frames])
    columns = {name: value for name, value in document.items() if isinstance(value, list)}
    return _columns(path, columns)


def _npz(path: Path) -> SignalTable:
    return _columns(path, {name: values for name, values in read_npz(path).items() if values.ndim})


def _columns(path: Path, columns: Mapping[str, Any]) -> SignalTable:
    """A table of whole columns: a row of an array, or a number, for each frame. Vectors of coefficients alone are one frame."""
    moving = {name: values for name, values in columns.items() if name not in IDENTITY and len(values)}
    rows = {
        name: values
        for name, values in moving.items()
        if isinstance(values[0], list) or (isinstance(values[0], np.ndarray) and values[0].ndim)
    }
    if not rows and any(name in moving for name in NAMES["expression"]):
        return SignalTable(path, {name: [values] for name, values in moving.items()}, ["frame 0"])
    length = max(map(len, (rows or moving).values()), default=0)
    return SignalTable(path, columns, [f"frame {number}" for number in range(length)])


def _joined(path: Path, places: Sequence[str], frames: Sequence[Mapping[str, Any]]) -> SignalTable:
    """A table of frames, all with the columns of the first."""
    names = list(frames[0]) if frames else []
    for place, frame in zip(places, frames):
        if set(frame) != set(names):
            other = min(set(frame) ^ set(names))
            found = "a new one" if other in frame else "none"
            raise InputError(path, f"{place}, {other}", f"the columns of {places[0]}", found)
    return SignalTable(path, {name: [frame[name] for frame in frames] for name in names}, places)


def _folder(path: Path) -> SignalTable:
    """A folder of files, each a frame; of folders, each a frame with an npy file for each array; or of npy files of all frames."""
    folders = sorted((p for p in path.iterdir() if p.is_dir() and any(p.glob("*.npy"))), key=natural_order)
    if folders:
        frames = [{file.stem: read_npy(file) for file in user_files(p, "*.npy")} for p in folders]
        return _joined(path, [folder.name for folder in folders], frames)
    arrays = {file.stem: read_npy(file) for file in user_files(path, "*.npy")}
    if arrays:
        return _columns(path, arrays)
    readers: dict[str, Callable[[Path], Mapping[str, Any]]] = {"*.npz": read_npz, "*.json": read_json}
    for pattern, read in readers.items():
        files = sorted(user_files(path, pattern), key=natural_order)
        if files:
            return _joined(path, [file.name for file in files], [read(file) for file in files])
    raise InputError(path, "", "files npz, npy or json of a signal's frames, or a capture", "none")


def natural_order(path: Path) -> list[tuple[bool, int | str]]:
    """Key that sorts names by their numbers: 2 before 10."""
    return [(part.isdigit(), int(part) if part.isdigit() else part) for part in re.split(r"(\d+)", path.stem)]


_READERS: Mapping[str, Callable[[Path], SignalTable]] = {
    ".csv": _csv,
    ".jsonl": _json_lines,
    ".ndjson": _json_lines,
    ".json": _json,
    ".npz": _npz,
}
