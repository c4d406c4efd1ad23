"""The live display on a terminal: overall progress, activity of each cell, and its training loss as a curve."""

from __future__ import annotations

import logging
import math
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Self

from .terminal import wrapped

BLOCKS, ASCII_BLOCKS = "▁▂▃▄▅▆▇█", "_.-=+*#@"
BAR, ASCII_BAR = "█░", "#."
BAR_WIDTH, CURVE_WIDTH, MOST_CELLS = 12, 24, 8
"""Width of the bar and of a curve in characters, and number of cells with separate lines."""
LOSS = re.compile(r"\bloss (\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)")
"""Matches the loss in a method's progress note."""


@dataclass(frozen=True)
class Position:
    """Progress of some work.

    Attributes
    ----------
    text : str
        Complete text in one line, for logs.
    label : str
        First line of a display.
    share : float
        Completed fraction, from 0 to 1.
    cells : Mapping[str, str]
        Activity of each running cell by name, one line each.
    """

    text: str
    label: str
    share: float
    cells: Mapping[str, str] = field(default_factory=dict)


class Curve:
    """Values over time in a fixed number of columns, each the mean of the same number of values.

    Parameters
    ----------
    width : int
        Number of columns, even.
    """

    def __init__(self, width: int = CURVE_WIDTH):
        self._width, self._each = width, 1
        self._columns: list[list[float]] = []

    def add(self, value: float) -> None:
        """Append a value. When all columns are full, pairs of them are merged."""
        if self._columns and len(self._columns[-1]) < self._each:
            self._columns[-1].append(value)
            return
        if len(self._columns) == self._width:
            self._each *= 2
            self._columns = [a + b for a, b in zip(self._columns[::2], self._columns[1::2], strict=True)]
        self._columns.append([value])

    @property
    def last(self) -> float:
        """The last value."""
        return self._columns[-1][-1]

    def text(self, blocks: str = BLOCKS) -> str:
        """The curve, one character per column. The scale is logarithmic if all values are positive."""
        means = [sum(column) / len(column) for column in self._columns]
        heights = [math.log(mean) for mean in means] if all(mean > 0 for mean in means) else means
        low, high = min(heights, default=0.0), max(heights, default=0.0)
        top = len(blocks) - 1
        return "".join(blocks[round(top * (h - low) / (high - low)) if high > low else 0] for h in heights)


class Display:
    """Lines at the end of a terminal that are updated in place."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        class Steady(Console):
            """A console that leaves the cursor visible, so that nothing is left to restore after a kill."""

            def show_cursor(self, show: bool = True) -> bool:
                return False

        self._console = Steady(
            file=sys.stderr,
            force_terminal=True,
            force_interactive=True,
            color_system=None,
            highlight=False,
            markup=False,
            emoji=False,
        )
        # Other output appears above the display; standard output is not redirected unless it is a terminal.
        self._live = Live(
            console=self._console, auto_refresh=False, transient=True, redirect_stdout=sys.stdout.isatty()
        )
        self._curves: dict[str, Curve] = {}
        self._last: dict[str, str] = {}

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def show(self, position: Position) -> None:
        """Update the lines."""
        from rich.text import Text

        lines = "\n".join(self._lines(position))
        self._live.update(Text(lines, no_wrap=True, overflow="crop"), refresh=True)

    def print(self, text: str) -> None:
        """Print above the display; the terminal wraps long lines."""
        self._console.print(text, soft_wrap=True)

    def _lines(self, position: Position) -> list[str]:
        ascii_only = self._console.options.ascii_only
        bar = ASCII_BAR if ascii_only else BAR
        done = round(BAR_WIDTH * min(max(position.share, 0.0), 1.0))
        lines = [f"{bar[0] * done}{bar[1] * (BAR_WIDTH - done)} {position.label}"]
        self._curves = {name: curve for name, curve in self._curves.items() if name in position.cells}
        for name, doing in list(position.cells.items())[:MOST_CELLS]:
            loss = LOSS.search(doing)
            curve = self._curves.setdefault(name, Curve())
            if loss and self._last.get(name) != doing:
                curve.add(float(loss[1]))
            self._last[name] = doing
            blocks = ASCII_BLOCKS if ascii_only else BLOCKS
            lines.append(f"  {name}: {doing}")
            if drawn := curve.text(blocks):
                lines.append(f"  loss {drawn:<{CURVE_WIDTH}} {curve.last:.3g}")
        more = len(position.cells) - MOST_CELLS
        return [*lines, f"  and {more} more"] if more > 0 else lines


_displays: list[Display] = []
"""The current display, if any; a process has at most one."""


def is_interactive() -> bool:
    """Whether standard error is a terminal on which lines can be updated."""
    # A display replaces standard error by an object that does not report a terminal.
    return bool(_displays) or (sys.stderr.isatty() and os.environ.get("TERM", "") not in ("dumb", "unknown"))


def current() -> Display | None:
    """The current display."""
    return _displays[0] if _displays else None


@contextmanager
def displayed() -> Iterator[Display]:
    """Show a display while the block runs, and remove it at its end."""
    with Display() as display:
        _displays.append(display)
        try:
            yield display
        finally:
            _displays.remove(display)


class TerminalHandler(logging.StreamHandler):
    """Writes messages to standard error, wrapped, above the display if there is one."""

    def format(self, record: logging.LogRecord) -> str:
        return wrapped(super().format(record), self.stream)

    def emit(self, record: logging.LogRecord) -> None:
        display = current()
        if display is None:
            super().emit(record)
        else:
            display.print(self.format(record))
