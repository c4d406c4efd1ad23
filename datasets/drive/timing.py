"""Times of a signal's frames, from timecodes, time stamps, frame numbers and names of files."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError

RATES = (24, 25, 30, 48, 50, 60, 100, 120, 240)
"""Usual frames per second, which timecodes count."""
SLOWEST, FASTEST = 5.0, 240.0
"""Rates between which a column of times is taken for one; its unit follows, since the ranges of the units do not overlap."""
UNITS = (1.0, 1e-3, 1e-6, 1e-9)
NEAR = 0.02
"""Relative difference up to which the rate of a signal is taken for one of `RATES`."""
GAP = 1.5
"""Frames; a longer step between two frames is a gap."""
DAY = 86400.0

_TIME = re.compile(
    r"time[ _]?(code|stamp)?([ _(]*(in)?[ _(]*(n|u|m|milli|micro)?s(ec(onds)?)?\)?)?", re.IGNORECASE
)
_NUMBER = re.compile(r"frame[ _]?(number|num|no|nr|id|idx|index)?", re.IGNORECASE)
_TIMECODE = re.compile(r"(\d+):(\d\d):(\d\d)[:;](\d+(?:\.\d+)?)")
"""Hours, minutes, seconds, and frames with a fraction."""
ONE_FACE = "If these are two faces of one frame, keep those of one face."


@dataclass(frozen=True, eq=False)
class Timing:
    """When the frames of a signal were recorded.

    Attributes
    ----------
    positions : FloatArray
        (T,) increasing times of the frames, in frames since the first; a gap is a step above 1.
    last : float
        Time of the last frame of the signal; those at its ends may lack a face and a position.
    fps : float | None
        Frames per second, if the signal states them.
    column : str
        Column of a table that states the times, or "".
    """

    positions: FloatArray
    last: float
    fps: float | None = None
    column: str = ""

    @classmethod
    def regular(cls, count: int, fps: float | None = None) -> Timing:
        """``count`` consecutive frames."""
        return cls(np.arange(count, dtype=np.float64), count - 1.0, fps)

    @classmethod
    def of_numbers(cls, numbers: Sequence[int], column: str = "") -> Timing:
        """Frames with increasing numbers, whose common divisor is one frame."""
        steps = np.diff(np.array(numbers, np.float64))
        positions = np.concatenate([[0.0], np.cumsum(steps)]) / (math.gcd(*map(int, steps)) or 1)
        return cls(positions, float(positions[-1]), None, column)

    @classmethod
    def of_seconds(cls, seconds: FloatArray, column: str = "") -> Timing:
        """Frames at increasing times. Their rate is one of `RATES` near the usual step, or its mean without gaps."""
        steps = np.diff(seconds)
        found = [1.0 / np.median(steps), 1.0 / steps[steps < GAP * np.median(steps)].mean()]
        near = [rate for fps in found for rate in RATES if abs(fps - rate) <= NEAR * rate]
        fps = float((near or found[1:])[0])
        positions = (seconds - seconds[0]) * fps
        if (
            steps.min() * fps < 0.5 and abs(positions[-1] - len(steps)) < 0.5
        ):  # rounded times, no frame missing
            positions = np.arange(len(seconds), dtype=np.float64)
        return cls(positions, float(positions[-1]), fps, column)

    def where(self, rows: Sequence[bool]) -> Timing:
        """The frames of a mask (T,)."""
        return replace(self, positions=self.positions[np.array(rows)])


def natural_order(path: Path) -> list[tuple[bool, int | str]]:
    """Key that sorts names by their numbers: 2 before 10."""
    return [(part.isdigit(), int(part) if part.isdigit() else part) for part in re.split(r"(\d+)", path.stem)]


def in_order(paths: Sequence[Path]) -> tuple[list[Path], Timing]:
    """Files or folders of one frame each by the number of the frame in their names, and their times.

    Names may have a second number after that of the frame, such as a face's. Raises `InputError` for two of one frame.
    """
    paths = sorted(paths, key=natural_order)
    numbers = [[int(part) for part in re.findall(r"\d+", path.stem)] for path in paths]
    if len({*map(len, numbers)}) != 1:
        return paths, Timing.regular(len(paths))
    varying = [values for values in zip(*numbers) if len({*values}) > 1]
    if not 1 <= len(varying) <= 2:
        return paths, Timing.regular(len(paths))
    by_number: dict[int, list[Path]] = {}
    for number, path in zip(varying[0], paths):
        by_number.setdefault(number, []).append(path)
    doubled = {number: found for number, found in by_number.items() if len(found) > 1}
    if doubled:
        names = " and ".join(path.name for path in next(iter(doubled.values())))
        found = f"{names}; more than one of frames {', '.join(map(str, doubled))}"
        raise InputError(paths[0].parent, "", "one file or folder a frame", found, ONE_FACE)
    return [by_number[number][0] for number in sorted(by_number)], Timing.of_numbers(sorted(by_number))


def from_columns(path: Path, columns: dict[str, Any], places: Sequence[str]) -> Timing | None:
    """Times by a column of timecodes, of times in a unit that gives a usual rate, or of frame numbers; None without one.

    Raises `InputError` for times that do not increase.
    """
    found: tuple[str, FloatArray] | None = None
    for pattern in (_TIME, _NUMBER):
        for name, column in columns.items():
            if found is None and pattern.fullmatch(name) and len(column) == len(places) > 1:
                values = _timecodes(column) if pattern is _TIME else None
                values = _numbers(column, pattern is _TIME) if values is None else values
                found = None if values is None else (name, values)
    if found is None:
        return None
    name, values = found
    steps = np.diff(values)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        expected = f"a later one than in {places[row - 1]}"
        raise InputError(path, f"{name}, {places[row]}", expected, str(columns[name][row]), ONE_FACE)
    if _TIME.fullmatch(name):
        return Timing.of_seconds(values, name)
    return Timing.of_numbers([int(value) for value in values], name)


def _timecodes(column: Sequence[Any]) -> FloatArray | None:
    """(T,) seconds of timecodes, whose rate is the lowest above all numbers of frames; None for other values or within one second."""
    matches = [_TIMECODE.fullmatch(str(value).strip()) for value in column]
    parts = np.array([[float(part) for part in match.groups()] for match in matches if match])
    if len(parts) < len(column) or (parts[:, 2] == parts[0, 2]).all():
        return None
    rate = next((rate for rate in RATES if rate > parts[:, 3].max()), None)
    if rate is None:
        return None
    seconds = parts @ [3600.0, 60.0, 1.0, 1.0 / rate]
    return seconds + DAY * np.cumsum(np.diff(seconds, prepend=seconds[0]) < -DAY / 2)


def _numbers(column: Sequence[Any], times: bool) -> FloatArray | None:
    """(T,) seconds of numeric times, or frame numbers; None for other values."""
    try:
        values = np.array(column, np.float64)
    except (TypeError, ValueError):
        return None
    if values.ndim != 1 or not np.isfinite(values).all() or not (steps := np.diff(values)).any():
        return None
    if not times:
        return values if (values == np.round(values)).all() else None
    step = np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
    unit = next((unit for unit in UNITS if 1 / FASTEST <= step * unit <= 1 / SLOWEST), None)
    return None if unit is None else unit * (values - values[0])
