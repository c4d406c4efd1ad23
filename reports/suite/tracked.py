"""Tables of methods that were trained on the capture's tracking and on tracking estimated from its images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..runs import RunSet
from ..table_report import Columns, table_of
from ..tables import Column, Table, TableCell, TableRow
from .ablations import difference_table, meaning_of

NOVEL, METRIC = "novel_view", "psnr"
DROP = "Drop"


def drop_table(runs: RunSet) -> Table:
    """PSNR of all tasks, and a last column for each other task: that of novel views minus that of the task."""
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


def tracked_table(runs: RunSet, tracked: Mapping[str, str]) -> Table:
    """Differences that tracking from images makes, a row for each method: ``tracked`` has its label by the label of the method."""
    pairs = [(changed, method) for method, changed in tracked.items()]
    names = {changed: method for method, changed in tracked.items()}
    meaning = meaning_of("Trained on tracking from images minus on the capture's tracking")
    return difference_table(runs, pairs, names, "Tracked from images", meaning, "methods")
