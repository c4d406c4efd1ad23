"""Tables of values over time: CSV, JSON, JSON lines, npz, and folders with one file per frame.

A table has a row for each frame of the file. Rows without a face have empty values, and `SignalTable.with_face` leaves them out.

Names of the arrays of FLAME coefficients in the outputs of trackers.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, check_numbers, read_npy, read_npz
from ...bench.io.documents import parse_json, read_text, shown
from ...bench.io.files import reading, user_files
from ..open import describe
from .timing import Timing, from_columns, in_order, is_empty

NAMES: Mapping[str, tuple[str, ...]] = {
    "expression": ("expression", "expression_params", "exp", "expcode", "expr"),
    "jaw": ("jaw", "jaw_pose", "jaw_params", "jawpose"),
    "rotation": ("rotation", "pose_params", "torso_pose", "global_pose", "globalpose"),
    "neck": ("neck", "neck_pose"),
    "eyes": ("eyes", "eyes_pose", "eye_pose"),
    "left_eye": ("eye_l_pose",),
    "right_eye": ("eye_r_pose",),
    "eyelids": ("eyelids", "eyelid_params"),
    "translation": ("translation",),
    "pose": ("pose", "posecode"),
}
"""Names of the arrays by part; ``pose`` is rotation, then jaw, of DECA and EMOCA. The first name that is found counts."""

IDENTITY = (
    "shape",
    "shapecode",
    "shape_params",
    "shape_from_facenet",
    "static_offset",
    "dynamic_offset",
    "betas",
)
"""Names of arrays of the subject, of any length."""


_CATEGORY_NAMES, _SCORE = ("categoryName", "category_name"), "score"
"""Keys of MediaPipe's categories in its JavaScript, Java and C#, and in its Python."""
_CATEGORIES = "categories"
"""Key of the list of a face's categories, in all but Python."""
_FACES = ("faceblendshapes", "face_blendshapes", "blendshapes")
"""Keys, in lower case, of the faces of a frame; empty in a frame without one."""
_COUNT, _SUCCESS = "blendshapecount", "success"
"""Columns that are 0 in a row without a face, in lower case: of Live Link Face, whose row ends there, and of OpenFace."""

_NAMES, _WEIGHTS = ("facsNames", "names"), ("weightMat", "weights")
"""Keys of the names of blendshapes and of their values, of Audio2Face in a document and of LAM in each frame."""
_RATES, _METADATA = ("exportfps", "fps", "framerate"), ("metadata", "meta")
"""Keys of the frames per second, in lower case without ``_``, and of the objects of a document that may have them too."""
MOST_FPS = 1000

_FRAMES = "frames"
"""Key of a JSON document with a list of frames."""


@dataclass(frozen=True, eq=False)
class SignalTable:
    """Columns of a signal, not yet checked: each is converted when it is used."""

    path: Path
    """File or folder, named in errors."""
    columns: Mapping[str, Sequence[Any] | np.ndarray]
    """T values by name: numbers, text, lists of numbers, or an array (T, ...)."""
    places: Sequence[str]
    """Location of each of the T frames in the file, such as "line 7"."""
    timing: Timing
    """Times of the T frames."""

    def __len__(self) -> int:
        return len(self.places)

    def with_face(self, names: Sequence[str]) -> SignalTable:
        """The rows with a value in any of the columns ``names``, and without ``success`` 0; all of them if that is none."""
        columns = [self.columns[name] for name in names]
        tracked = [column for name, column in self.columns.items() if name.lower() == _SUCCESS]
        if any(len(column) != len(self) for column in (*columns, *tracked)):
            return self
        rows = [
            not all(is_empty(column[row]) for column in columns)
            and not any(str(column[row]).strip().lower() in ("0", "0.0", "false") for column in tracked)
            for row in range(len(self))
        ]
        if all(rows) or not any(rows):
            return self
        kept = [row for row, face in enumerate(rows) if face]
        chosen = {
            name: column[kept] if isinstance(column, np.ndarray) else [column[row] for row in kept]
            for name, column in self.columns.items()
            if len(column) == len(self)
        }
        return replace(
            self,
            columns={**self.columns, **chosen},
            places=[self.places[row] for row in kept],
            timing=self.timing.where(rows),
        )

    def values(self, name: str) -> FloatArray:
        """(T, n) float64 values of a column; n is 1 for single numbers. Raises `InputError` for values that are not
        finite numbers within `MAX_MAGNITUDE`, and for frames of unequal length."""
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
        """(T,) values of a column with one number a frame."""
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
            found = "none" if value is None else shown(value)
            raise InputError(self.path, f"{name}, {place}", expected, found) from None


def read_table(path: Path, fps: float | None = None) -> SignalTable:
    """Read a file by its ending, or a folder with files of each frame. Times are those of a column, if there are any.
    With ``fps``, frames per second, a column of times that gives no rate is no error."""
    read = _folder if path.is_dir() else _READERS.get(path.suffix.lower())
    if read is None:
        expected = f"a file in {', '.join(_READERS)}, or a folder"
        found, remedy = describe(path)
        if found == "a file":
            found, remedy = f"a file in {path.suffix or path.name}", "Save the signal as npz or CSV."
        raise InputError(path, "", expected, found, remedy)
    table = read(path)
    if not len(table) or not table.columns:
        raise InputError(path, "", "at least one frame with values", "none")
    stated = table.timing.fps
    timing = from_columns(path, table.columns, table.places, bool(fps or stated))
    return table if timing is None else replace(table, timing=replace(timing, fps=timing.fps or stated))


def parse_line(text: str, path: Path, place: str) -> dict[str, Any]:
    """Columns of a frame in JSON; MediaPipe's lists of categories become one column each."""
    text = "{}" if text.strip() == "null" else _without_nan(text)
    return _expanded(parse_json(text, path, place), path, place)


def _without_nan(text: str) -> str:
    """JSON with null for NaN, which Python writes and JSON does not have."""
    return (
        re.sub(r'("(?:[^"\\]|\\.)*")|NaN', lambda match: match[1] or "null", text) if "NaN" in text else text
    )


def _expanded(frame: Mapping[str, Any], path: Path, place: str, names: Sequence[str] = ()) -> dict[str, Any]:
    """Columns of a frame, also of objects in it, with one for each of MediaPipe's categories or of the ``names`` of weights."""
    line: dict[str, Any] = {}
    for name, value in frame.items():
        faces = value if isinstance(value, list) else [value]
        if faces and isinstance(faces[0], dict) and not isinstance(faces[0].get(_CATEGORIES), list):
            faces = [faces]  # the categories of one face
        scores = [_categories(face) for face in faces]
        if isinstance(value, dict) and scores[0] is None:
            line |= _expanded(value, path, place)
        elif name in _WEIGHTS and names:
            line |= _weights(value, path, f"{place}, {name}", names)
        elif scores and scores[0] is not None:
            if len(scores) > 1:
                remedy = "Track one face, or keep the entry of one."
                raise InputError(path, f"{place}, {name}", "one face a frame", f"{len(scores)}", remedy)
            line |= scores[0]
        elif value or name.lower() not in _FACES:
            line[name] = value
    return line


def _weights(row: Any, path: Path, place: str, names: Sequence[str]) -> dict[str, Any]:
    """Values by name of a row of weights; none of an empty row."""
    if not is_empty(row) and not (isinstance(row, list) and len(row) == len(names)):
        found = str(len(row)) if isinstance(row, list) else shown(row)
        raise InputError(path, place, f"{len(names)} values a row, as there are names", found)
    return dict(zip(names, row or ()))


def _categories(face: Any) -> dict[str, Any] | None:
    """Scores by name, if the value is MediaPipe's list of categories of a face, or has one."""
    while isinstance(face, list) and len(face) == 1 and isinstance(face[0], list):
        face = face[0]
    items = face.get(_CATEGORIES) if isinstance(face, dict) else face
    if not isinstance(items, list) or not items or not all(isinstance(item, dict) for item in items):
        return None
    columns = {}
    for item in items:
        names = [item[key] for key in _CATEGORY_NAMES if isinstance(item.get(key), str)]
        if not names or _SCORE not in item:
            return None
        columns[names[0]] = item[_SCORE]
    return columns


def _csv(path: Path) -> SignalTable:
    text = read_text(path, "CSV")
    with reading(path, "a CSV file"):
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    if not rows:
        raise InputError(path, "", "a header and a line for each frame", "an empty file")
    names = [name.strip() for name in rows[0][1]]
    wrong = [name for name in names[1:] if not name or names.count(name) > 1]
    wrong = names if re.match(r"sep=|[^,]*[;\t][^,]*$", ",".join(names)) else wrong
    if wrong:
        found = shown(wrong[0]) if wrong[0] else f"column {names.index('', 1) + 1} without a name"
        raise InputError(path, "header", "distinct names of columns, separated by commas", found)
    count = next((index for index, name in enumerate(names) if name.lower() == _COUNT), None)
    for number, row in rows[1:]:
        if count is not None and [cell.strip() for cell in row[count : count + 1]] == ["0"]:
            row[count + 1 :] = [""] * (len(names) - count - 1)
        if len(row) != len(names):
            expected = f"{len(names)} values, as the header has names"
            raise InputError(path, f"line {number}", expected, str(len(row)))
    # the first column has no name if it is the index of pandas
    columns = {name: [row[index] for _, row in rows[1:]] for index, name in enumerate(names) if name}
    return _table(path, columns, [f"line {number}" for number, _ in rows[1:]])


def _json_lines(path: Path) -> SignalTable:
    lines = read_text(path, "JSON lines").splitlines()
    frames = {f"line {number}": line for number, line in enumerate(lines, 1) if line.strip()}
    return _joined(path, [*frames], [parse_line(line, path, place) for place, line in frames.items()])


def _json(path: Path) -> SignalTable:
    text = read_text(path, "JSON")
    key = "" if text.lstrip().startswith("[") else _FRAMES
    document = parse_json(_without_nan(text if key else f'{{"{_FRAMES}": {text}}}'), path)
    frames, names = document.get(_FRAMES), _named(document, _NAMES, list) or []
    fps = _rate(path, document) or _rate(path, _named(document, _METADATA, dict) or {})
    if isinstance(frames, list):
        places = [f"{key}[{number}]" for number in range(len(frames))]
        for frame, place in zip(frames, places):
            if frame is not None and not isinstance(frame, dict):
                raise InputError(path, place, "an object", shown(frame))
        rows = [_expanded(frame or {}, path, place, names) for frame, place in zip(frames, places)]
        return _joined(path, places, rows, fps=fps)
    columns = {name: value for name, value in document.items() if isinstance(value, list)}
    if not columns and any(isinstance(v, dict) and next(iter(v), "").isdigit() for v in document.values()):
        remedy = 'Of pandas, write to_json(orient="records").'
        raise InputError(path, "", "an object of lists, or a list of objects", "an object of objects", remedy)
    for key in _WEIGHTS if names else ():
        if key in columns:
            rows = [_weights(row, path, f"{key}[{n}]", names) for n, row in enumerate(columns[key])]
            columns = {name: value for name, value in columns.items() if name not in (key, *_NAMES)}
            columns |= {name: [row.get(name) for row in rows] for name in names}
    return _columns(path, columns, fps)


def _named(document: Mapping[str, Any], keys: Sequence[str], kind: type) -> Any:
    """The first entry under one of the keys that is of a kind; None without one."""
    return next((document[key] for key in keys if isinstance(document.get(key), kind)), None)


def _rate(path: Path, document: Mapping[str, Any]) -> float | None:
    """Frames per second that a document states."""
    for key, value in document.items():
        value = value[0] if isinstance(value, list) and len(value) == 1 else value
        if key.lower().replace("_", "") in _RATES and not is_empty(value) and not isinstance(value, list):
            if re.fullmatch(r"\s*\d+(\.\d*)?\s*", str(value)) and 1 <= float(value) <= MOST_FPS:
                return float(value)
            raise InputError(path, key, f"frames per second, from 1 to {MOST_FPS}", shown(value))
    return None


def _npz(path: Path) -> SignalTable:
    arrays = read_npz(path)
    fps = _rate(path, {name: values.item() for name, values in arrays.items() if values.size == 1})
    return _columns(path, {name: values for name, values in arrays.items() if values.ndim}, fps)


def _columns(path: Path, columns: Mapping[str, Any], fps: float | None = None) -> SignalTable:
    """A table of whole columns: a row of an array, or a number, for each frame. Vectors of coefficients alone are one frame."""
    moving = {name: values for name, values in columns.items() if name not in IDENTITY and len(values)}
    rows = {
        name: values
        for name, values in moving.items()
        if (values.ndim > 1 if isinstance(values, np.ndarray) else any(isinstance(v, list) for v in values))
    }
    if not rows and any(name in moving for name in NAMES["expression"]):
        return _table(path, {name: [values] for name, values in moving.items()}, ["frame 0"])
    length = max(map(len, (rows or moving).values()), default=0)
    return _table(path, columns, [f"frame {number}" for number in range(length)], fps)


def _table(
    path: Path, columns: Mapping[str, Any], places: Sequence[str], fps: float | None = None
) -> SignalTable:
    """A table of consecutive frames."""
    return SignalTable(path, columns, places, Timing.regular(len(places), fps))


def _joined(
    path: Path, places: Sequence[str], frames: Sequence[Mapping[str, Any]], fps: float | None = None
) -> SignalTable:
    """A table of consecutive frames with the columns of all; None where a frame lacks one."""
    names = dict.fromkeys(name for frame in frames for name in frame)
    return _table(path, {name: [frame.get(name) for frame in frames] for name in names}, places, fps)


def _folder(path: Path) -> SignalTable:
    """A folder of files, each a frame; of folders, each a frame with an npy file for each array; or of npy files of all frames."""
    folders = [*dict.fromkeys(file.parent for file in user_files(path, "*/*.npy"))]
    files = user_files(path, "*.npy")
    if files and not folders:
        return _columns(path, {file.stem: read_npy(file) for file in files})
    sources: Sequence[tuple[Sequence[Path], Callable[[Path], Mapping[str, Any]]]] = (
        (folders, lambda folder: {file.stem: read_npy(file) for file in user_files(folder, "*.npy")}),
        (user_files(path, "*.npz"), read_npz),
        (user_files(path, "*.json"), lambda file: parse_line(read_text(file, "JSON"), file, "")),
    )
    for found, read in sources:
        if found:
            ordered, timing = in_order(found)
            table = _joined(path, [place.name for place in ordered], [read(place) for place in ordered])
            return replace(table, timing=timing)
    expected = "files npz, npy or json of a signal's frames, or a capture"
    raise InputError(path, "", expected, *describe(path))


_READERS: Mapping[str, Callable[[Path], SignalTable]] = {
    ".csv": _csv,
    ".jsonl": _json_lines,
    ".ndjson": _json_lines,
    ".json": _json,
    ".npz": _npz,
}
