"""The live display on a terminal: overall progress and the activity of each cell."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Self

from .terminal import wrapped

BAR, ASCII_BAR = "█░", "#."
BAR_WIDTH, MOST_CELLS = 12, 8
"""Width of the bar in characters, and number of cells with separate lines."""


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
        bar = ASCII_BAR if self._console.options.ascii_only else BAR
        done = round(BAR_WIDTH * min(max(position.share, 0.0), 1.0))
        lines = [f"{bar[0] * done}{bar[1] * (BAR_WIDTH - done)} {position.label}"]
        lines += [f"  {name}: {doing}" for name, doing in list(position.cells.items())[:MOST_CELLS]]
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
