"""Tables for pages: best rows first, with columns without values replaced by a sentence."""

from __future__ import annotations

from dataclasses import replace
from math import inf

from .tables import Column, Table, TableCell, TableRow


def compact(table: Table) -> Table:
    """Sort the rows of each group by the first column that has values, best first, and leave out columns without any.

    A column that is left out becomes a sentence in the caption, with its first reason. Columns in which a method failed
    are kept. Notes that no cell refers to are removed.
    """
    kept = [index for index in range(len(table.columns)) if _has_content(table, index)]
    if not kept:
        return table
    left_out: dict[str, list[str]] = {}
    for index, column in enumerate(table.columns):
        if index not in kept:
            note = next(
                (row.cells[index].note for row in table.rows if row.cells[index].note is not None), None
            )
            why = "" if note is None else table.notes[note]
            left_out.setdefault(why, []).append(f"{column.title} {column.label}".strip())
    sentences = [
        f"No values of {', '.join(names)}{f': {why}' if why else ''}".rstrip(".") + "."
        for why, names in left_out.items()
    ]
    used: dict[int, int] = {}

    def cells(row: TableRow) -> tuple[TableCell, ...]:
        own = [row.cells[index] for index in kept]
        return tuple(
            cell if cell.note is None else replace(cell, note=used.setdefault(cell.note, len(used)))
            for cell in own
        )

    columns = tuple(table.columns[index] for index in kept)
    groups = []
    for title, rows in table.groups:
        ordered = sorted(rows, key=lambda row: _place(row.cells[kept[0]], columns[0]))
        groups.append((title, tuple(replace(row, cells=cells(row)) for row in ordered)))
    return replace(
        table,
        columns=columns,
        groups=tuple(groups),
        notes=tuple(table.notes[note] for note in used),
        missing=(*table.missing, *sentences),
    )


def _has_content(table: Table, index: int) -> bool:
    cells = [row.cells[index] for row in table.rows]
    return any(cell.value is not None or cell.status == "failed" for cell in cells)


def _place(cell: TableCell, column: Column) -> float:
    """Sort key of rows: the value, negated if higher is better; rows without a value last."""
    if cell.value is None:
        return inf
    return -cell.value if column.higher_is_better else cell.value
