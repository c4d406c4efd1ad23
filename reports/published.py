"""Figures that papers printed, beside measured ones: in columns of their own that say so, never ranked.

``published.json`` holds them as printed, each row with the paper, the table and the data it is of.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from ..bench.configuration import build
from ..bench.errors import InputError
from ..bench.io.documents import read_json
from ..bench.manifest import MethodRecord
from .csv_table import column_name
from .table_model import Table, TableCell

FILE = Path(__file__).with_name("published.json")


@dataclass(frozen=True)
class PublishedRow:
    """A row of a paper's table.

    Attributes
    ----------
    source : key of the paper.
    table, data : where in the paper, and what the figures are of.
    layout : of the table it may stand in.
    method, settings : the method's name here, and the settings that a measured one needs to be the same.
    values : as printed, by ``task/metric``.
    """

    source: str
    table: str
    data: str
    layout: str
    method: str
    settings: dict[str, Any]
    values: dict[str, str]

    def is_of(self, record: MethodRecord) -> bool:
        """Whether a measured method, as in a run's manifest, is the one of this row."""
        config = record.config or {}
        settled = all(name in config and config[name] == value for name, value in self.settings.items())
        return record.name == self.method and settled


@cache
def published_rows() -> tuple[tuple[PublishedRow, str], ...]:
    """All rows, each with its source in words. Raises `InputError` for a file that is not as it should be."""
    content = read_json(FILE)
    rows = [
        build(PublishedRow, entry, str(FILE), f"figures.{i}.") for i, entry in enumerate(content["figures"])
    ]
    for row in rows:
        if row.source not in content["sources"]:
            raise InputError(FILE, "source", ", ".join(content["sources"]), row.source)
    return tuple((row, str(content["sources"][row.source])) for row in rows)


def with_published(table: Table, layout: str, records: Mapping[str, MethodRecord]) -> Table:
    """Put a column "published" behind each measured one that a paper's table of this layout has a figure for.

    Parameters
    ----------
    records : by label of the table's methods, what they were, as in a run's manifest.
    """
    notes = list(table.notes)
    figures: dict[str, tuple[Mapping[str, str], int]] = {}
    for row in table.rows:
        for published, source in published_rows():
            if published.layout == layout and published.is_of(records[row.method]):
                note = f"Published: {published.table} ({published.data}) of {source}."
                if note not in notes:
                    notes.append(note)
                figures[row.method] = published.values, notes.index(note)
    known = {name for values, _ in figures.values() for name in values}
    shown = [column_name(column) in known for column in table.columns]
    columns = []
    for column, beside in zip(table.columns, shown):
        columns += [column, replace(column, published=True)] if beside else [column]

    def cells(method: str, measured: tuple[TableCell, ...]) -> tuple[TableCell, ...]:
        values, note = figures.get(method, ({}, 0))
        result = []
        for column, cell, beside in zip(table.columns, measured, shown):
            result.append(cell)
            if beside:
                text = values.get(column_name(column))
                none = TableCell("none", None, "")
                result.append(none if text is None else TableCell("published", float(text), text, note=note))
        return tuple(result)

    groups = tuple(
        (title, tuple(replace(row, cells=cells(row.method, row.cells)) for row in rows))
        for title, rows in table.groups
    )
    return replace(table, columns=tuple(columns), groups=groups, notes=tuple(notes))
