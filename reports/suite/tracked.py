"""Tables of methods that were trained on the capture's tracking and on tracking estimated from its images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..runs import RunSet
from ..table_report import Columns, table_of
from ..tables import Column, Table, TableCell, TableRow
from .ablations import difference_table

NOVEL, SELF, METRIC = "novel_view", "self_reenactment", "psnr"
DROP = "Drop"


def drop_table(runs: RunSet) -> Table:
    """PSNR of both tasks, and a last column with their difference, novel view minus self-reenactment."""
    table = table_of(runs, columns=Columns((METRIC,)))
    places = {column.task: index for index, column in enumerate(table.columns)}
    shown = table.columns[places[NOVEL]]
    column = Column("", DROP, METRIC, shown.label, shown.unit, shown.digits, higher_is_better=False)

    def with_drop(row: TableRow) -> TableRow:
        first, second = (row.cells[places[task]].value for task in (NOVEL, SELF))
        cell = TableCell("missing", None, "–")
        if first is not None and second is not None:
            cell = TableCell("ok", first - second, f"{first - second:.{column.digits}f}")
        return replace(row, cells=(*row.cells, cell))

    return replace(table.mapped(with_drop), columns=(*table.columns, column))


def tracked_table(runs: RunSet, tracked: Mapping[str, str]) -> Table:
    """Differences that tracking from images makes, a row for each method: ``tracked`` has its label by the label of the method."""
    pairs = [(changed, method) for method, changed in tracked.items()]
    names = {changed: method for method, changed in tracked.items()}
    meaning = "Trained on tracking from images minus on the capture's tracking"
    return difference_table(runs, pairs, names, "Tracked from images", meaning, "methods")
