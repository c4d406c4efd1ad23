"""The live display of a terminal: how much is done, what each cell does, and the loss of its training as a curve."""

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

BLOCKS, ASCII_BLOCKS = "▁▂▃▄▅▆▇█", "_.-=+*#@"
BAR, ASCII_BAR = "█░", "#."
BAR_WIDTH, CURVE_WIDTH, MOST_CELLS = 24, 24, 8
"""Characters of the bar and of a curve, and number of cells with a line of their own."""
LOSS = re.compile(r"\bloss (\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)")
"""The loss in a note of a method's progress."""


@dataclass(frozen=True)
class Position:
    """How far some work is.

    Attributes
    ----------
    text : str
        Everything in one line, for logs.
    label : str
        The first line of a display.
    share : float
        Share that is done, from 0 to 1.
    cells : Mapping[str, str]
        What each cell that is running does, by its name: a line of a display each.
    """

    text: str
    label: str
    share: float
    cells: Mapping[str, str] = field(default_factory=dict)


class Curve:
    """Values over time in a fixed number of columns, each the mean of equally many values.

    Parameters
    ----------
    width : int
        Number of columns, even.
    """

    def __init__(self, width: int = CURVE_WIDTH):
        self._width, self._each = width, 1
        self._columns: list[list[float]] = []

    def add(self, value: float) -> None:
        """Append a value. When all columns are full, pairs of them become one."""
        if self._columns and len(self._columns[-1]) < self._each:
            self._columns[-1].append(value)
            return
        if len(self._columns) == self._width:
            self._each *= 2
            self._columns = [a + b for a, b in zip(self._columns[::2], self._columns[1::2], strict=True)]
        self._columns.append([value])

    @property
    def last(self) -> float:
        """The value that was added last."""
        return self._columns[-1][-1]

    def text(self, blocks: str = BLOCKS) -> str:
        """The curve, a character for each column. The scale is logarithmic where all values are positive."""
        means = [sum(column) / len(column) for column in self._columns]
        heights = [math.log(mean) for mean in means] if all(mean > 0 for mean in means) else means
        low, high = min(heights, default=0.0), max(heights, default=0.0)
        top = len(blocks) - 1
        return "".join(blocks[round(top * (h - low) / (high - low)) if high > low else 0] for h in heights)


class Display:
    """Lines at the end of a terminal that are written again in place."""

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
        # What is printed meanwhile appears above the display; standard output keeps its place if it is no terminal.
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
        """Write the lines again."""
        from rich.text import Text

        lines = "\n".join(self._lines(position))
        self._live.update(Text(lines, no_wrap=True, overflow="crop"), refresh=True)

    def print(self, text: str) -> None:
        """Print above the display; long lines are left to the terminal."""
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
"""The display that is shown, if any: a process has one at most."""


def is_interactive() -> bool:
    """Whether standard error is a terminal on which lines can be written again."""
    # A display replaces standard error by an object that does not say that it is a terminal.
    return bool(_displays) or (sys.stderr.isatty() and os.environ.get("TERM", "") not in ("dumb", "unknown"))


def current() -> Display | None:
    """The display that is shown."""
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
    """Writes messages to standard error, above the display where there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        display = current()
        if display is None:
            super().emit(record)
        else:
            display.print(self.format(record))
