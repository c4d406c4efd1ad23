"""Builds the comparison table from rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..bench.protocol import TASK_TITLES
from ..bench.rows import ALL, Rows
from ..bench.runner.scoring import FULL
from ..bench.specs import MetricSpec
from .aggregate import Aggregate, summarise
from .ranking import best_of_column, marking, ranked
from .table_model import Column, Table, TableCell, TableRow, TaskSummary

AVATAR_TITLE = "Avatar"
METHODS_TITLE = "Methods"
FLOOR_TITLE = "Floor (not ranked)"


def build_table(
    rows: Rows,
    metrics: Sequence[MetricSpec],
    methods: Sequence[str],
    *,
    trivial: Sequence[str] = (),
    tasks: Sequence[str] | None = None,
    protocol_ids: Mapping[str, str] | None = None,
    region: str = FULL,
    image_size: str = "",
    machine: str = "",
    avatar_title: str = AVATAR_TITLE,
) -> Table:
    """Build the comparison table.

    A cell has a value only where every frame of the task has one, for every seed the method was run with: means
    over different frames do not compare. Otherwise it shows "–" or "failed", and a note says why.

    Parameters
    ----------
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
    rows.check()
    rows.check_protocols("rows")
    present = rows.tasks
    known = [task for task in TASK_TITLES if task in present]
    tasks = [*known, *sorted(present - set(known))] if tasks is None else tasks
    columns = _columns(metrics, tasks, avatar_title)
    summaries = [_task_summary(rows, task, region, (protocol_ids or {}).get(task, "")) for task in tasks]

    notes: list[str] = []
    lines: list[TableRow] = []
    for method in methods:
        found = (summarise(rows, method=method, metric=c.metric, task=c.task, region=region) for c in columns)
        cells = tuple(_cell(aggregate, c.digits, notes) for aggregate, c in zip(found, columns))
        lines.append(TableRow(method, ", ".join(rows.versions(method)), method in trivial, cells))
    markings = [best_of_column(rows, lines, index, column, region) for index, column in enumerate(columns)]
    lines = ranked(lines, columns, markings)
    groups = (
        (METHODS_TITLE, tuple(line for line in lines if not line.trivial)),
        (FLOOR_TITLE, tuple(line for line in lines if line.trivial)),
    )
    return Table(
        columns=columns,
        groups=tuple((title, members) for title, members in groups if members),
        notes=tuple(notes),
        tasks=tuple(summaries),
        seeds=max(1, len(rows.seeds(ALL))),
        marking=marking(columns, lines, markings),
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


def _task_summary(rows: Rows, task: str, region: str, protocol_id: str) -> TaskSummary:
    frames = rows.frames(task, region)
    subjects = {key[0] for key in frames}
    title = TASK_TITLES.get(task, task)
    return TaskSummary(task, title, protocol_id, "".join(rows.protocols(task)), len(frames), len(subjects))


def _cell(aggregate: Aggregate, digits: int, notes: list[str]) -> TableCell:
    if aggregate.value is not None:
        # A digit more than the value: seeds move means less than methods do.
        spread = "" if aggregate.spread is None else f"{aggregate.spread:.{digits + 1}f}"
        return TableCell("ok", aggregate.value, f"{aggregate.value:.{digits}f}", spread)
    if aggregate.reason not in notes:
        notes.append(aggregate.reason)
    text = "failed" if aggregate.status == "failed" else "–"
    return TableCell(aggregate.status, None, text, note=notes.index(aggregate.reason))
