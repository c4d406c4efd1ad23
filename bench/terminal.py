"""Text and tables for a terminal, fitted to its width; for a pipe, plain and as wide as they need.

``COLUMNS`` sets the width of a terminal. ``NO_COLOR`` and ``TERM=dumb`` leave out styles, which only repeat what the text says.
"""

from __future__ import annotations

import codecs
import io
import json
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Sequence
from typing import Any, TextIO

IN_ASCII = dict(
    zip("↑↓±×·–—…²µ•→°", ("^", "v", "+/-", "x", "-", "-", "--", "...", "^2", "u", "*", "->", " deg"))
)
"""ASCII replacements of the characters in headbench's output, for ASCII terminals."""


def prepare_streams() -> None:
    """Let standard output and error replace characters that their encoding lacks instead of raising an error.

    A stream that the caller has closed (``headbench … >&-``) is discarded.
    """
    codecs.register_error("headbench", _in_ascii)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - open until the process ends
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="headbench")


def _in_ascii(error: UnicodeError) -> tuple[str, int]:
    """Error handler for characters that an encoding lacks: replace them by `IN_ASCII`, or by JSON escapes."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(IN_ASCII.get(c) or json.dumps(c)[1:-1] for c in lacking), error.end


def show(text: str = "", end: str = "\n") -> None:
    """Print the result of a command. A closed pipe (``headbench compare … | head -1``) does not change the exit code."""
    try:
        print(text, end=end, flush=True)
    except OSError as error:
        # Buffered output must not fail again when the interpreter exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            error.filename = "standard output"
            raise


LEAST = 16
"""Characters below which a column of text is not narrowed."""
UNLIMITED = 100_000
_NUMBER = re.compile(r"[-+]?\d")
_MARKS = re.compile(r"(?: \*)?(?: \[\d+\])?$")
_GROUP = "\0"
"""Drawn between groups of rows, until their title replaces it."""


def width_of(stream: TextIO | None) -> int | None:
    """Characters of a line of a stream, by default of standard output; None if it is no terminal."""
    # A display of progress replaces standard output.
    used: Any = stream or getattr(sys.stdout, "rich_proxied_file", sys.stdout)
    return max(40, shutil.get_terminal_size().columns) if used.isatty() else None


def wrapped(text: str, stream: TextIO | None = None) -> str:
    """Wrap long lines between words. They continue below their text, after a bullet and columns at the beginning."""
    width = width_of(stream)
    return text if width is None else "\n".join(_wrapped(line, width) for line in text.split("\n"))


def _wrapped(line: str, width: int) -> str:
    if "\x1b" in line or len(line) <= width:  # a line with styles is one of a table, which fits
        return line
    starts = re.finditer(r"^ *(?:(?:[-*]|\[\d+\]) )?|\S {2,}(?=\S)", line[: width * 2 // 3])
    indent = " " * max(match.end() for match in starts)
    return textwrap.fill(line, width, subsequent_indent=indent, break_on_hyphens=False)


def table(
    head: Sequence[str], lines: Sequence[Sequence[str]], *, names: int = 1, title: str = "", fit: bool = True
) -> str:
    """Align a table: numbers right, text left, under a line of dashes.

    Columns that do not fit are continued below, again with the first ``names`` columns. A line of one cell is the title
    of those below it. A cell may end with an asterisk (the best of its column, bold on a terminal) and the number of
    a note in brackets. Without ``fit`` the text is that for a pipe.
    """
    from rich.box import Box
    from rich.cells import cell_len
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    limit = width_of(None) if fit else None
    styled, width = bool(limit and not os.environ.get("NO_COLOR")), limit or UNLIMITED
    # Without a height, a dumb terminal has 80 columns.
    console = Console(width=width, height=25, force_terminal=styled, highlight=False)
    ruled = Box(f"    \n    \n -  \n    \n {_GROUP}  \n    \n    \n    \n", ascii=True)
    columns = list(zip(head, *(line for line in lines if len(line) > 1), strict=True))
    numbers = {i for i, column in enumerate(columns) if i >= names and any(map(_NUMBER.match, column[1:]))}
    columns = [_to_the_right(column) if i in numbers else column for i, column in enumerate(columns)]
    most = [width // 2 // names if i < names else width if i in numbers else LEAST for i in range(len(head))]
    sizes = [min(size, max(map(cell_len, column))) for size, column in zip(most, columns)]
    parts = [[*range(names)]]
    for i in range(names, len(head)):
        if len(parts[-1]) > names and sum(sizes[j] + 2 for j in [*parts[-1], i]) - 2 > width:
            parts.append([*range(names)])
        parts[-1].append(i)
    texts: list[str] = []
    for columns_of_part in parts:
        grid = Table(box=ruled, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
        for i in columns_of_part:
            fixed = sizes[i] if i < names or i in numbers else None
            grid.add_column(Text(columns[i][0]), width=fixed, overflow="fold")
        rows = zip(*(columns[i][1:] for i in columns_of_part), strict=True)
        for line in lines:
            if len(line) == 1:
                grid.add_section()
            else:
                grid.add_row(*(Text(cell, "bold" if " *" in cell[1:] else "") for cell in next(rows)))
        groups = [textwrap.fill(line[0], width) for line in lines if len(line) == 1]
        with console.capture() as printed:
            if title:
                console.print(Text(f"{title}, continued" if texts else title, "bold"))
            console.print(grid)
        shown = []
        for text in printed.get().splitlines():
            shown.append(groups.pop(0) if _GROUP in text else text.rstrip())
            # That of the first rows, below the line of dashes.
            if lines and len(lines[0]) == 1 and not text.strip("- "):
                shown.append(groups.pop(0))
        texts.append("\n".join(shown))
    return "\n\n".join(texts)


def _to_the_right(column: Sequence[str]) -> tuple[str, ...]:
    """A head and cells of equal length, with numbers to the right and marks behind them."""
    parts = [(cell[: match.start()], match[0]) for cell in column[1:] if (match := _MARKS.search(cell))]
    marks = max(len(mark) for _, mark in parts)
    size = max(len(column[0]) - marks, *(len(value) for value, _ in parts))
    cells = (value.rjust(size) + mark.ljust(marks) for value, mark in parts)
    return column[0].rjust(size + marks), *cells
