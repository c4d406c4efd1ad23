"""The table as CSV, for spreadsheets and scripts: full precision, no markup."""

from __future__ import annotations

import csv
import io

from .table_model import Column, Table


def to_csv(table: Table) -> str:
    """Write one line per method.

    Columns: method, version, group; per column of the table the value (``novel_view/psnr``, full precision,
    empty where there is none), its rank (``.../rank``), its status (``.../status``) and, with several seeds, its
    standard deviation from seed to seed as displayed (``.../spread``), or for a published column the paper's figure
    alone; notes; protocol.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    header = ["method", "version", "group"]
    extras = ["rank", "status", *(["spread"] if table.seeds > 1 else [])]
    for column in table.columns:
        name = column_name(column)
        header += [name] if column.published else [name, *(f"{name}/{extra}" for extra in extras)]
    writer.writerow([*header, "notes", "protocol"])
    protocol = " ".join(f"{task.task}={task.protocol_hash}" for task in table.tasks)
    for title, rows in table.groups:
        for row in rows:
            line = [row.method, row.version, title]
            for column, cell in zip(table.columns, row.cells):
                line.append("" if cell.value is None else repr(cell.value))
                if not column.published:
                    line += [str(cell.rank or ""), cell.status, cell.spread][: len(extras)]
            notes = sorted({cell.note for cell in row.cells if cell.note is not None})
            writer.writerow([*line, " ".join(table.notes[note] for note in notes), protocol])
    return stream.getvalue()


def column_name(column: Column) -> str:
    """``task/metric``, or the metric alone for one of the avatar as a whole; ``.../published`` for a paper's."""
    name = f"{column.task}/{column.metric}" if column.task else column.metric
    return f"{name}/published" if column.published else name
