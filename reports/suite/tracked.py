"""Tables of methods under a condition of tracking: next to the plain methods, and as differences from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..runs import RunSet
from ..table_report import Columns, table_of
from ..tables import Column, Table, TableCell, TableRow
from .ablations import difference_table, meaning_of

NOVEL, METRIC = "novel_view", "psnr"
DROP = "Drop"
DROP_MEANING = f"{DROP} to a task: novel views minus that task."


def drop_table(runs: RunSet) -> Table:
    """PSNR of all tasks, and a last column for each other task: novel views minus that task."""
    table = table_of(runs, columns=Columns((METRIC,)))
    (first,) = (place for place, column in enumerate(table.columns) if column.task == NOVEL)
    others = [place for place in range(len(table.columns)) if place != first]

    def drop(place: int) -> Column:
        shown = table.columns[place]
        title = f"{DROP} to {shown.title.lower()}"
        return Column("", title, METRIC, shown.label, shown.unit, shown.digits, higher_is_better=False)

    def with_drops(row: TableRow) -> TableRow:
        return replace(row, cells=(*row.cells, *(_difference(row, first, place, table) for place in others)))

    columns = (*table.columns, *map(drop, others))
    return replace(table.mapped(with_drops), columns=columns)


def _difference(row: TableRow, first: int, second: int, table: Table) -> TableCell:
    novel, other = row.cells[first].value, row.cells[second].value
    if novel is None or other is None:
        return TableCell("missing", None, "–")
    difference = novel - other
    return TableCell("ok", difference, f"{difference:.{table.columns[second].digits}f}")


def condition_table(runs: RunSet, changed: Mapping[str, str], title: str) -> Table:
    """Effects of a condition, one row per method.

    Parameters
    ----------
    changed : mapping of str
        Label of the method under the condition by its plain label.
    title : str
        Heading of the rows.
    """
    pairs = [(label, method) for method, label in changed.items()]
    names = {label: method for method, label in changed.items()}
    return difference_table(
        runs, pairs, names, title, meaning_of("With the condition minus without"), "methods"
    )
