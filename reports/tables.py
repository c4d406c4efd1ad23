"""The comparison table as a typed model, built from rows; the writers only lay it out.

A value is a mean of means: frames -> sequence -> subject -> seed, each level weighing its members equally
(macro), so that a long sequence or a subject with many frames does not outvote the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import pandas as pd

from ..bench.errors import InputError
from ..bench.protocol import TASK_TITLES
from ..bench.specs import MetricSpec
from .aggregate import Aggregate, check_rows, summarise, task_frames

AVATAR_TITLE = "Avatar"
METHODS_TITLE = "Methods"
FLOOR_TITLE = "Floor (not ranked)"


@dataclass(frozen=True)
class Column:
    """One metric of one task (``task`` "" for a metric of the avatar as a whole)."""

    task: str
    title: str
    metric: str
    label: str
    unit: str
    digits: int
    higher_is_better: bool

    @property
    def arrow(self) -> str:
        """Which way is better: an arrow up or down."""
        return "↑" if self.higher_is_better else "↓"


@dataclass(frozen=True)
class TableCell:
    """A value, or why there is none.

    Attributes
    ----------
    status : "ok", "missing" (could not or was not measured) or "failed" (the method ended in an error).
    value : full precision; None unless ok.
    text : as displayed.
    rank : 1 for the best, 2 for the second-best displayed value, ...; None where nothing is ranked.
    note : index into `Table.notes`, or None.
    """

    status: Literal["ok", "missing", "failed"]
    value: float | None
    text: str
    rank: int | None = None
    note: int | None = None


@dataclass(frozen=True)
class TableRow:
    """A method's cells, one per column; a trivial method is a floor and never ranked."""

    method: str
    version: str
    trivial: bool
    cells: tuple[TableCell, ...]


@dataclass(frozen=True)
class TaskSummary:
    """What stands behind a task's columns."""

    task: str
    title: str
    protocol_id: str
    protocol_hash: str
    frames: int
    subjects: int


@dataclass(frozen=True)
class Table:
    """A comparison, ready to be written in any format."""

    columns: tuple[Column, ...]
    groups: tuple[tuple[str, tuple[TableRow, ...]], ...]  # (title, rows); empty groups are left out
    notes: tuple[str, ...]
    tasks: tuple[TaskSummary, ...]
    seeds: int
    image_size: str = ""
    machine: str = ""

    @property
    def rows(self) -> tuple[TableRow, ...]:
        """All rows, in order."""
        return tuple(row for _, rows in self.groups for row in rows)

    @property
    def caption(self) -> str:
        """One paragraph: what was measured, on how much, under which protocol, and how it was averaged."""
        parts = []
        for task in self.tasks:
            frames = "1 frame" if task.frames == 1 else f"{task.frames} frames"
            subjects = "1 subject" if task.subjects == 1 else f"{task.subjects} subjects"
            name = f"{task.protocol_id} " if task.protocol_id else ""
            parts.append(f"{task.title}: {frames}, {subjects}, protocol {name}({task.protocol_hash}).")
        if self.image_size:
            parts.append(f"Images of {self.image_size} pixels.")
        seeds = "one seed" if self.seeds == 1 else f"{self.seeds} seeds"
        parts.append(f"Mean over frames, then sequences, then subjects; {seeds}.")
        if any(cell.rank for row in self.rows for cell in row.cells):
            parts.append("Best bold, second underlined, by the digits shown.")
        if self.machine and any(column.metric == "fps" for column in self.columns):
            parts.append(f"Speed measured on {self.machine}.")
        return " ".join(parts)


def build_table(
    rows: pd.DataFrame,
    metrics: Sequence[MetricSpec],
    methods: Sequence[str],
    *,
    trivial: Sequence[str] = (),
    tasks: Sequence[str] | None = None,
    protocol_ids: Mapping[str, str] | None = None,
    region: str = "full",
    image_size: str = "",
    machine: str = "",
    avatar_title: str = AVATAR_TITLE,
) -> Table:
    """Build the comparison table.

    A cell has a value only where every frame of the task has one, for every seed the method was run with: means
    over different frames do not compare. Otherwise it shows "–" or "failed", and a note says why.

    Parameters
    ----------
    rows : columns as in `headbench.bench.store.Row`.
    metrics : columns of the table, in order; those per frame appear once in each task, the others last.
    methods : in order; one without rows is shown as not measured.
    trivial : those of ``methods`` that are floors: listed apart, not ranked.
    tasks : in order; by default those in ``rows``, the known ones first.
    protocol_ids : readable name of each task's protocol, for the caption.
    region : which region's rows are shown.
    image_size, machine : for the caption.
    avatar_title : heading of the columns that are of no task.

    Raises
    ------
    InputError : rows that lack a column, repeat a frame, have an undefined value, or mix protocols in a task.
    """
    rows = rows[rows["region"] == region] if "region" in rows.columns else rows
    check_rows(rows)
    present = set(rows["task"]) - {""}
    known = [task for task in TASK_TITLES if task in present]
    tasks = [*known, *sorted(present - set(known))] if tasks is None else tasks
    columns = _columns(metrics, tasks, avatar_title)
    summaries = [_task_summary(rows, task, (protocol_ids or {}).get(task, "")) for task in tasks]

    notes: list[str] = []
    lines: list[TableRow] = []
    for method in methods:
        own = rows[rows["method"] == method]
        cells = tuple(_cell(summarise(rows, own, c.task, c.metric), c.digits, notes) for c in columns)
        versions = sorted(set(own["version"].astype(str)))
        lines.append(TableRow(method, ", ".join(versions), method in trivial, cells))
    lines = _ranked(lines, columns)
    groups = (
        (METHODS_TITLE, tuple(line for line in lines if not line.trivial)),
        (FLOOR_TITLE, tuple(line for line in lines if line.trivial)),
    )
    return Table(
        columns=columns,
        groups=tuple((title, members) for title, members in groups if members),
        notes=tuple(notes),
        tasks=tuple(summaries),
        seeds=max(1, rows["seed"].nunique()),
        image_size=image_size,
        machine=machine,
    )


def _columns(metrics: Sequence[MetricSpec], tasks: Sequence[str], avatar_title: str) -> tuple[Column, ...]:
    def column(spec: MetricSpec, task: str, title: str) -> Column:
        return Column(task, title, spec.name, spec.label, spec.unit, spec.digits, spec.higher_is_better)

    per_frame = [
        column(m, task, TASK_TITLES.get(task, task)) for task in tasks for m in metrics if m.per_frame
    ]
    return (*per_frame, *(column(m, "", avatar_title) for m in metrics if not m.per_frame))


def _task_summary(rows: pd.DataFrame, task: str, protocol_id: str) -> TaskSummary:
    hashes = sorted(set(rows.loc[rows["task"] == task, "protocol"]))
    if len(hashes) > 1:
        raise InputError(
            "rows",
            f"protocol of {task}",
            "one protocol: numbers of different protocols do not compare",
            ", ".join(hashes),
            "Make one table for each protocol.",
        )
    frames = task_frames(rows, task)
    subjects = {key[0] for key in frames}
    title = TASK_TITLES.get(task, task)
    return TaskSummary(task, title, protocol_id, "".join(hashes), len(frames), len(subjects))


def _cell(aggregate: Aggregate, digits: int, notes: list[str]) -> TableCell:
    if aggregate.value is not None:
        return TableCell("ok", aggregate.value, f"{aggregate.value:.{digits}f}")
    if aggregate.reason not in notes:
        notes.append(aggregate.reason)
    text = "failed" if aggregate.status == "failed" else "–"
    return TableCell(aggregate.status, None, text, note=notes.index(aggregate.reason))


def _ranked(lines: Sequence[TableRow], columns: Sequence[Column]) -> list[TableRow]:
    """Rank displayed values within each column: equal ones share a rank, the next distinct one has the next.

    A column is ranked only if there is something to compare: two methods that are no floors.
    """
    cells = [list(line.cells) for line in lines]
    for index, column in enumerate(columns):
        competing = [i for i, line in enumerate(lines) if not line.trivial and cells[i][index].status == "ok"]
        if len(competing) < 2:
            continue
        shown = {i: float(cells[i][index].text) for i in competing}
        order = sorted(set(shown.values()), reverse=column.higher_is_better)
        for i, value in shown.items():
            cells[i][index] = replace(cells[i][index], rank=order.index(value) + 1)
    return [replace(line, cells=tuple(row)) for line, row in zip(lines, cells)]
