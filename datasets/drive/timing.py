"""Times of a signal's frames, from timecodes, time stamps, frame numbers and names of files."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.io.files import natural_order

RATES = (24, 25, 30, 48, 50, 60, 100, 120, 240)
"""Usual frames per second, which timecodes count."""
SLOWEST, FASTEST = 2.0, 240.0
"""Rates between which a column of times is taken for one; its unit follows, since the ranges of the units do not overlap."""
UNITS: Sequence[float] = (1.0, 1e-3, 1e-6, 1e-9)
NEAR = 0.02
"""Relative difference up to which the rate of a signal is taken for one of `RATES`."""
GAP = 1.5
"""Frames; a longer step between two frames is a gap."""
DAY = 86400.0

_TIME = re.compile(
    r"time[ _]?(code|stamp)?([ _(]*(in)?[ _(]*(n|u|m|milli|micro)?s(ec(onds)?)?\)?)?", re.IGNORECASE
)
_NUMBER = re.compile(r"frame[ _]?(number|num|no|nr|id|idx|index)?", re.IGNORECASE)
_CLOCK = re.compile(
    r"(?:\d{4}-\d\d-\d\d[T ])?(?:(\d+):)?(\d+):(\d\d(?:[.,]\d+)?)(?:[:;](\d+(?:\.\d+)?))?(?:Z|[+-]\d\d:?\d\d)?"
)
"""Hours, minutes, seconds, and of a timecode frames, with fractions. Date and time zone are not used."""
ONE_FACE = "If these are two faces of one frame, keep those of one face."


@dataclass(frozen=True, eq=False)
class Timing:
    """When the frames of a signal were recorded."""

    positions: FloatArray
    """(T,) increasing times of the frames, in frames since the first; a gap is a step above 1."""
    last: float
    """Time of the last frame of the signal; those at its ends may lack a face and a position."""
    fps: float | None = None
    """Frames per second, if the signal states them."""
    column: str = ""
    """Column of a table that states the times, or ""."""

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
        rates = [1.0 / np.median(steps), 1.0 / steps[steps < GAP * np.median(steps)].mean()]
        near = [rate for fps in rates for rate in RATES if abs(fps - rate) <= NEAR * rate]
        fps = float((near or rates[1:])[0])
        positions = (seconds - seconds[0]) * fps
        if (
            steps.min() * fps < 0.5 and abs(positions[-1] - len(steps)) < 0.5
        ):  # rounded times, no frame missing
            positions = np.arange(len(seconds), dtype=np.float64)
        return cls(positions, float(positions[-1]), fps, column)

    def where(self, rows: Sequence[bool]) -> Timing:
        """The frames of a mask (T,)."""
        return replace(self, positions=self.positions[np.array(rows)])


def in_order(paths: Sequence[Path]) -> tuple[list[Path], Timing]:
    """Files or folders of one frame each by the number of the frame in their names, and their times. The frame's is the
    first number that varies; some or all names may have a second, such as a face's."""
    paths = sorted(paths, key=lambda path: natural_order(path.stem))
    numbers = [[int(part) for part in re.findall(r"\d+", path.stem)] for path in paths]
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


def is_empty(value: Any) -> bool:
    """Whether a value is none: null, empty text, NaN, or a list of such values."""
    if isinstance(value, (np.ndarray, np.floating)):
        return value.dtype.kind == "f" and bool(np.isnan(value).all())
    if isinstance(value, list):
        return all(map(is_empty, value))
    return value is None or (isinstance(value, str) and value.strip().lower() in ("", "nan"))


def from_columns(
    path: Path, columns: Mapping[str, Any], places: Sequence[str], has_rate: bool
) -> Timing | None:
    """Times by a column of times, or of frame numbers; None without one. Times without a value are interpolated."""
    found: tuple[str, list[int], FloatArray] | None = None
    unread = ""
    for pattern, parsed in ((_TIME, _seconds), (_NUMBER, _numbers)):
        for name, column in columns.items():
            if found is None and pattern.fullmatch(name) and len(column) == len(places) > 1:
                rows = [row for row, value in enumerate(column) if not is_empty(value)]
                values = parsed([column[row] for row in rows])
                if values is not None and (pattern is _TIME or len(rows) == len(places)):
                    found = (name, rows, values)
                elif pattern is _TIME and rows:
                    unread = unread or name
    if unread and not has_rate and (found is None or not _TIME.fullmatch(found[0])):
        expected = f"times at {SLOWEST:g} to {FASTEST:g} frames a second, or timecodes of more than a second"
        times = [str(value) for value in columns[unread] if not is_empty(value)]
        raise InputError(path, unread, expected, ", ".join(times[:3]), "State the frame rate with --fps.")
    if found is None:
        return None
    name, rows, values = found
    steps = np.diff(values)
    if (steps <= 0).any():
        before, row = (rows[int(np.argmax(steps <= 0)) + offset] for offset in (0, 1))
        expected = f"a later one than in {places[before]}"
        raise InputError(path, f"{name}, {places[row]}", expected, str(columns[name][row]), ONE_FACE)
    if not _TIME.fullmatch(name):
        return Timing.of_numbers([int(value) for value in values], name)
    if len(rows) < len(places):
        values = make_interp_spline(rows, values, k=1)(np.arange(len(places)))
    return Timing.of_seconds(values, name)


def _seconds(column: Sequence[Any]) -> FloatArray | None:
    """(T,) seconds of clock times, timecodes or numbers, whose unit follows from the rate; None for other values. The
    rate of timecodes is the lowest above all their numbers of frames; within one second they give none."""
    clocks = [_CLOCK.fullmatch(str(value).strip()) for value in column]
    values, units = _finite(column), UNITS
    if all(clocks):
        parts = np.array([[float((p or "0").replace(",", ".")) for p in m.groups()] for m in clocks if m])
        rate = next((rate for rate in RATES if parts.size and rate > parts[:, 3].max()), None)
        if rate is None or (parts[:, 3].any() and (parts[:, 2] == parts[0, 2]).all()):
            return None
        values = parts @ [3600.0, 60.0, 1.0, 1.0 / rate]
        values, units = values + DAY * np.cumsum(np.diff(values, prepend=values[0]) < -DAY / 2), UNITS[:1]
    if values is None or not ((steps := np.diff(values)) > 0).any():
        return None
    step = np.median(steps[steps > 0])
    unit = next((unit for unit in units if 1 / FASTEST <= step * unit <= 1 / SLOWEST), None)
    return None if unit is None else unit * (values - values[0])


def _numbers(column: Sequence[Any]) -> FloatArray | None:
    """(T,) frame numbers; None for other values, and for one number throughout."""
    values = _finite(column)
    return None if values is None or (values % 1).any() or not np.diff(values).any() else values


def _finite(column: Sequence[Any]) -> FloatArray | None:
    """(T,) numbers; None for other values."""
    try:
        values = np.array(column, np.float64)
    except (TypeError, ValueError):
        return None
    return values if values.ndim == 1 and np.isfinite(values).all() else None
