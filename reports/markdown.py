"""The table as Markdown, aligned so that it also reads well unrendered."""

from __future__ import annotations

import re

from .table_model import Table, TableCell

MARKS = {1: ("**", "**"), 2: ("<ins>", "</ins>"), 3: ("*", "*")}


def to_markdown(table: Table) -> str:
    """Write a pipe table. Header: tasks, first body row: metrics.

    First bold, second underlined (``<ins>``), third italic.
    """
    tasks, names = [""], ["**Method**"]
    for index, column in enumerate(table.columns):
        follows = index > 0 and table.columns[index - 1].title == column.title
        tasks.append("" if follows else escape(column.title))
        unit = f" ({escape(column.unit)})" if column.unit else ""
        names.append(
            "*published*" if column.published else f"**{escape(column.label)}**{unit} {column.arrow}"
        )
    lines = [tasks, names]
    for title, rows in table.groups:
        if len(table.groups) > 1:
            lines.append([f"*{escape(title)}*", *[""] * len(table.columns)])
        lines += [[escape(row.method), *map(_cell, row.cells)] for row in rows]
    widths = [max(3, *(len(line[i]) for line in lines)) for i in range(len(names))]
    body = [
        _line([c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(x, widths))])
        for x in lines
    ]
    rule = _line([":" + "-" * (widths[0] - 1), *("-" * (w - 1) + ":" for w in widths[1:])])
    notes = [f"<sup>{i + 1}</sup> {escape(note)}  " for i, note in enumerate(table.notes)]
    parts = ["\n".join([body[0], rule, *body[1:]]), escape(table.caption)]
    return "\n\n".join([*parts, *(["\n".join(notes)] if notes else [])]) + "\n"


def escape(text: str) -> str:
    """Make text stand for itself in Markdown, on one line; an underscore within a word already does."""
    return re.sub(r"([\\`*{}\[\]<>|#~&]|(?<!\w)_|_(?!\w))", r"\\\1", " ".join(text.split()))


def _cell(cell: TableCell) -> str:
    text = escape(cell.shown)
    if cell.rank in MARKS:
        before, after = MARKS[cell.rank]
        text = f"{before}{text}{after}"
    return text if cell.note is None else f"{text}<sup>{cell.note + 1}</sup>"


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
