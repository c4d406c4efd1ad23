"""The table as CSV, for spreadsheets and scripts: full precision, no markup."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence

from .table_model import Column, Table

FORMULA_STARTS = ("=", "+", "-", "@")


def to_csv(table: Table) -> str:
    """Write one line per method.

    Columns: method, version, group; per column of the table the value (``novel_view/psnr``, full precision,
    empty where there is none), its rank (``.../rank``), its status (``.../status``) and, with several seeds, its
    standard deviation from seed to seed as displayed (``.../spread``), or for a published column the paper's figure
    alone; notes; protocol.
    """
    header = ["method", "version", "group"]
    extras = ["rank", "status", *(["spread"] if table.seeds > 1 else [])]
    for column in table.columns:
        name = column_name(column)
        header += [name] if column.published else [name, *(f"{name}/{extra}" for extra in extras)]
    lines: list[list[object]] = [[*header, "notes", "protocol"]]
    protocol = " ".join(f"{task.task}={task.protocol_hash}" for task in table.tasks)
    for title, rows in table.groups:
        for row in rows:
            line: list[object] = [row.method, row.version, title]
            for column, cell in zip(table.columns, row.cells):
                line.append("" if cell.value is None else repr(cell.value))
                if not column.published:
                    line += [str(cell.rank or ""), cell.status, cell.spread][: len(extras)]
            notes = sorted({cell.note for cell in row.cells if cell.note is not None})
            lines.append([*line, " ".join(table.notes[note] for note in notes), protocol])
    return csv_text(lines)


def csv_text(lines: Iterable[Sequence[object]]) -> str:
    """Write lines as CSV, None as an empty cell.

    Text that a spreadsheet would take for a formula has an apostrophe in front, as OWASP advises ("CSV Injection").
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerows([_inert(value) for value in line] for line in lines)
    return stream.getvalue()


def _inert(value: object) -> object:
    if not isinstance(value, str):
        return value
    value = value.replace("\r", " ")  # which the writer leaves bare, and readers take for the end of the line
    if not value.lstrip().startswith(FORMULA_STARTS):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def column_name(column: Column) -> str:
    """``task/metric``, or the metric alone for one of the avatar as a whole; ``.../published`` for a paper's."""
    name = f"{column.task}/{column.metric}" if column.task else column.metric
    return f"{name}/published" if column.published else name
