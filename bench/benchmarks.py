"""What the benchmarks of ``headbench bench`` and ``headbench stress`` share: runs that take turns, and tables of rows."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, TypeVar

from .specs import Findings

Key = TypeVar("Key", bound=Hashable)
Row = Mapping[str, Any]
"""A row of a table: text, whole numbers, floats or None by column."""


def take_turns(
    runs: Mapping[Key, Callable[[], object]],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Key, list[float]]:
    """Time several things in turn, so that whatever else the machine does meets all of them alike.

    A first round warms up and does not count.

    Returns
    -------
    dict[Key, list[float]]
        The seconds of ``rounds`` runs of each, by key.
    """
    seconds: dict[Key, list[float]] = {key: [] for key in runs}
    for _ in range(rounds + 1):
        for key, run in runs.items():
            start = clock()
            run()
            seconds[key].append(clock() - start)
    return {key: each[1:] for key, each in seconds.items()}


def findings(tables: Mapping[str, Sequence[Row]], note: str, faults: Sequence[str] = ()) -> Findings:
    """What a benchmark found: its tables by title, a note on how to read them, and what breaks a bound."""
    parts = [f"{title}\n\n{table(rows)}" for title, rows in tables.items() if rows]
    data = {title: [dict(row) for row in rows] for title, rows in tables.items()}
    return Findings("\n\n".join([*parts, note, *faults]), data, passed=not faults)


def table(rows: Sequence[Row]) -> str:
    """Align rows under the names of their columns; numbers to the right, floats with three significant digits."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [names, *([_cell(row.get(name)) for name in names] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    texts = [any(isinstance(row.get(name), str) for row in rows) for name in names]
    lines = [
        "  ".join(
            cell.ljust(width) if text else cell.rjust(width)
            for cell, width, text in zip(line, widths, texts, strict=True)
        ).rstrip()
        for line in cells
    ]
    return "\n".join([lines[0], "  ".join("-" * width for width in widths), *lines[1:]])


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
    return str(value)
