"""Measured tables in the form of a published table, with its rows below."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from ..bench.errors import HeadbenchError, InputError
from ..bench.manifest import MethodRecord
from ..bench.protocol import TASK_TITLES
from ..bench.registry import get
from ..bench.specs import MetricSpec
from .papers import OF_AVATARS, OF_FRAMES, TASKS, PrintedRow, PrintedTable, paper_named
from .runs import RunSet
from .tables import Table, TableCell, TableRow, build_table
from .writers import column_name


def as_printed(runs: RunSet, name: str, printed: PrintedTable) -> Table:
    """A table with the columns of a published one: measured methods, then the published rows, which are not ranked.

    Values are means over all cameras, as in papers. Methods have the names used in the paper. Of conditions, those are
    shown that are a row of the table by their settings alone. Raises `InputError` if the runs have no task of the table.
    """
    metrics = _metrics(runs, printed)
    asked = {key.rpartition("/")[0] for key in printed.keys} - {""}
    tasks = [task for task in TASKS if task in asked and task in runs.tasks]
    if asked and not tasks:
        raise InputError(runs.runs[0].folder.root, "tasks", " or ".join(sorted(asked)), ", ".join(runs.tasks))
    names = {label: _name(runs.records[label], label, printed) for label in _measured(runs, printed)}
    measured = build_table(
        runs.rows,
        metrics,
        list(names),
        tasks,
        protocol_ids=runs.protocol_ids,
        image_size=runs.image_size,
        cut=runs.cut,
        machine=runs.machine,
        part=runs.part,
        keys=runs.keys,
        averaged=runs.averaged,
        name=f"{name}-{printed.number}",
    ).mapped(lambda row: replace(row, method=names[row.method]))
    rows = tuple(TableRow(row.name, "", True, _cells(row, measured)) for row in printed.rows)
    title = f"Printed in {printed.table} of the paper (not comparable): {printed.data}"
    absent = [TASK_TITLES[task] for task in TASKS if task in asked and task not in tasks]
    missing = [f"{task} is printed, but not measured here." for task in absent]
    said = (
        f"Printed values: {paper_named(name).citation}.",
        f"Their conditions: {printed.conditions}. Read in: {printed.read} (grade {printed.grade}).",
    )
    return replace(
        measured,
        groups=(*measured.groups, (title, rows)),
        missing=(*measured.missing, *missing),
        printed=said,
    )


def _measured(runs: RunSet, printed: PrintedTable) -> list[str]:
    """Labels of the ranked methods, and of conditions whose changed settings, and nothing else, make them a row of the table."""
    known = {c.name: c for run in runs.runs for c in run.manifest.configuration.conditions}
    chosen = {*runs.ranked}
    for row in printed.rows:
        own = {label for label, record in runs.records.items() if row.is_of(record)}
        if own.isdisjoint(runs.ranked):
            chosen |= {label for label in own if known[runs.records[label].condition].changes_settings_alone}
    return [label for label in runs.methods if label in chosen]


def _metrics(runs: RunSet, printed: PrintedTable) -> list[MetricSpec]:
    """The metrics of a published table with its decimals, even if the runs lack them."""
    known = {spec.name: spec for spec in runs.metrics}
    used = {key.rpartition("/")[2]: bool(key.rpartition("/")[0]) for key in printed.keys}
    found = []
    for metric, of_frames in used.items():
        label, unit, higher = (OF_FRAMES if of_frames else OF_AVATARS)[metric]
        spec = known.get(metric)
        if spec is None:
            with suppress(HeadbenchError):  # no installed metric
                spec = get("metrics", metric)
        spec = spec or MetricSpec(metric, label, unit, higher, 0, "", kind="frame" if of_frames else "avatar")
        found.append(replace(spec, digits=printed.decimals(metric)))
    return found


def _name(record: MethodRecord, label: str, printed: PrintedTable) -> str:
    for row in printed.rows:
        if row.method and row.is_of(record):
            condition = f" ({record.condition})" if record.condition else ""
            return f"{row.name}{condition}{label.removeprefix(record.label)}"
    return label


def _cells(row: PrintedRow, table: Table) -> tuple[TableCell, ...]:
    texts = [row.values.get(column_name(column)) for column in table.columns]
    none = TableCell("none", None, "")
    return tuple(none if text is None else TableCell("published", float(text), text) for text in texts)
