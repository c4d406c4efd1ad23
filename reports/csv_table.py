"""The table as CSV, for spreadsheets and scripts: full precision, no markup."""

from __future__ import annotations

import csv
import io

from .tables import Column, Table


def to_csv(table: Table) -> str:
    """Write one line per method.

    Columns: method, version, group; per column of the table the value (``novel_view/psnr``, full precision,
    empty where there is none), its rank (``.../rank``) and its status (``.../status``); notes; protocol.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    header = ["method", "version", "group"]
    for column in table.columns:
        header += [column_name(column), f"{column_name(column)}/rank", f"{column_name(column)}/status"]
    writer.writerow([*header, "notes", "protocol"])
    protocol = " ".join(f"{task.task}={task.protocol_hash}" for task in table.tasks)
    for title, rows in table.groups:
        for row in rows:
            line = [row.method, row.version, title]
            for cell in row.cells:
                line += ["" if cell.value is None else repr(cell.value), str(cell.rank or ""), cell.status]
            notes = sorted({cell.note for cell in row.cells if cell.note is not None})
            writer.writerow([*line, " ".join(table.notes[note] for note in notes), protocol])
    return stream.getvalue()


def column_name(column: Column) -> str:
    """``task/metric``, or the metric alone for one of the avatar as a whole."""
    return f"{column.task}/{column.metric}" if column.task else column.metric
