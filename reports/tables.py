"""The table as a typed model, the input of the writers.

A value is a mean of means: frames -> sequence -> subject -> seed, with equal weights at each level (macro),
so that a long sequence or a subject with many frames does not dominate.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import TYPE_CHECKING, Literal

from ..bench.condition import CONDITION_MARK
from ..bench.contracts import FrameKey
from ..bench.progress import counted
from ..bench.protocol import TASK_TITLES
from ..bench.rows import ALL, FULL, Rows
from ..bench.specs import DYNAMIC, MetricSpec
from .aggregate import (
    AVERAGED,
    CODED_CHANGE,
    Aggregate,
    conditions,
    marks,
    measured_on,
    mechanisms,
    subject_means,
    summarise,
    suspects,
    whole_images,
)
from .statistics.comparisons import LEVEL, BestSet, best_set

if TYPE_CHECKING:
    from .runs import RunSet


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
    def name(self) -> str:
        """``task/metric``, or the metric alone for one of the avatar as a whole."""
        return f"{self.task}/{self.metric}" if self.task else self.metric

    @property
    def arrow(self) -> str:
        """Direction of better values: an arrow up or down."""
        return "↑" if self.higher_is_better else "↓"


@dataclass(frozen=True)
class TableCell:
    """A value, or the reason why it is missing.

    ``status`` is "ok", "missing" (could not be or was not measured),
    "failed" (the method raised an error), "published" (printed in a paper, not measured) or "none" (not printed there).
    """

    status: Literal["ok", "missing", "failed", "published", "none"]
    value: float | None  # full precision; None unless ok or published
    text: str  # as displayed
    spread: str = ""  # standard deviation over seeds, as displayed; "" with one seed
    rank: int | None = (
        None  # 1 for all that may be the best, then 2, 3, ... by displayed value; None if unranked
    )
    note: int | None = None  # index into `Table.notes`

    @property
    def shown(self) -> str:
        """Value and spread, as displayed."""
        return f"{self.text} ± {self.spread}" if self.spread else self.text


@dataclass(frozen=True)
class TableRow:
    """A method's cells, one per column; ``trivial``: it is not ranked, since it is a baseline or has a condition."""

    method: str
    version: str
    trivial: bool
    cells: tuple[TableCell, ...]


@dataclass(frozen=True)
class TaskSummary:
    """Data of a task's columns."""

    task: str
    title: str
    protocol_id: str
    protocol_hash: str
    frames: int
    subjects: int

    @property
    def size(self) -> str:
        """Amount of data in words."""
        return f"{counted(self.frames, 'frame')}, {counted(self.subjects, 'subject')}"


@dataclass(frozen=True)
class Table:
    """A comparison that can be written in any format."""

    columns: tuple[Column, ...]
    groups: tuple[tuple[str, tuple[TableRow, ...]], ...]  # (title, rows); empty groups are left out
    notes: tuple[str, ...]
    tasks: tuple[TaskSummary, ...]
    seeds: int
    warnings: tuple[str, ...] = ()  # methods not better than a trivial baseline, or whose mechanism is off
    marking: str = ""  # explains the ranks and their test
    starred: str = ""  # the same for text, which marks only the best
    image_size: str = ""
    cut: str = ""
    machine: str = ""
    part: str = ""  # of the frames, "" for all
    missing: tuple[str, ...] = ()  # why tasks have no columns
    name: str = ""  # the layout
    tested: bool = False  # whether ranks are by a test
    cameras: str = ""  # seen and unseen cameras, or why they are not shown separately
    printed: tuple[str, ...] = ()  # source of published values, then their conditions
    averaged: str = AVERAGED

    @property
    def titled(self) -> bool:
        """Whether the groups need titles."""
        common = (METHODS_TITLE, TRIVIAL_TITLE, CONDITIONS_TITLE)
        return len(self.groups) > 1 or any(title not in common for title, _ in self.groups)

    @property
    def rows(self) -> tuple[TableRow, ...]:
        """All rows, in order."""
        return tuple(row for _, rows in self.groups for row in rows)

    def mapped(self, change: Callable[[TableRow], TableRow]) -> Table:
        """Return the table with ``change`` applied to every row."""
        groups = tuple((title, tuple(map(change, rows))) for title, rows in self.groups)
        return replace(self, groups=groups)

    @property
    def caption(self) -> str:
        """One paragraph: metrics, amount of data, protocol, and averaging."""
        return " ".join(self.facts)

    @property
    def facts(self) -> tuple[str, ...]:
        """The sentences of the caption."""
        return (*self.warnings, *self.sentences(self.marking))

    def sentences(self, marking: str, *, details: bool = True) -> tuple[str, ...]:
        """What to know to read the table; with ``details`` also the protocols and how values were averaged."""
        parts = []
        for task in self.tasks if details else ():
            name = f"{task.protocol_id} " if task.protocol_id else ""
            parts.append(f"{task.title}: {task.size}, protocol {name}({task.protocol_hash}).")
        parts += [*self.missing, *filter(None, [self.cameras, self.part])]
        if self.image_size:
            parts.append(f"Images of {self.image_size} pixels{self.cut and f', {self.cut}'}.")
        spread = f"mean of {self.seeds} seeds ± standard deviation over seeds"
        seeds = spread if self.seeds > 1 else "one seed"
        if details:
            parts.append(f"Mean over {self.averaged}; {seeds}.")
        elif self.seeds > 1:
            parts.append(f"{spread.capitalize()}.")
        parts += [marking] if marking else []
        parts += self.printed
        if any(column.metric == CODED_CHANGE.name for column in self.columns):
            parts.append("By coding: change of PSNR by the codec, in the task with the lower value.")
        if self.machine and self.has_speed:
            parts.append(f"Speed measured on {self.machine}.")
        return tuple(parts)

    @property
    def short_caption(self) -> str:
        """Caption for a paper: `caption` without protocols and averaging."""
        subjects = [counted(task.subjects, "subject") for task in self.tasks]
        same = subjects[0] if len(set(subjects)) == 1 else ""
        tasks = []
        for task, own in zip(self.tasks, subjects):
            sizes = filter(None, [counted(task.frames, "frame"), "" if same else own])
            tasks.append(f"{task.title} ({', '.join(sizes)})")
        what = " and ".join(tasks) or " and ".join(dict.fromkeys(column.title for column in self.columns))
        size = f"images of {self.image_size.replace(' x ', '×')} pixels" if self.image_size else ""
        parts = [", ".join(filter(None, [what, same, size])) + "."]
        parts += [*filter(None, [self.cameras, self.part])]
        parts += [f"Mean ± standard deviation over {self.seeds} seeds."] if self.seeds > 1 else []
        ranks = {cell.rank for row in self.rows for cell in row.cells} - {None}
        if ranks:
            best = "All methods not distinguishable from the best in bold" if self.tested else "Best in bold"
            places = ["second underlined", *(["third in italics"] if 3 in ranks else [])]
            digits = [] if self.tested else ["by the digits shown"]
            parts.append(", ".join([best, *places, *digits]) + ".")
        parts += self.printed[:1]
        if self.machine and self.has_speed:
            parts.append(f"Speed on {self.machine}.")
        return " ".join(parts)

    @property
    def has_speed(self) -> bool:
        """Whether a column has frames per second."""
        return any(column.metric == "fps" for column in self.columns)


COMPARISON = "comparison"
"""Name of the layout that every run has."""
AVATAR_TITLE = "Avatar"
TITLES = {"speed": "Speed", "cost": "Storage and training", "mechanism": "Mechanisms"}
"""Titles of layouts whose columns belong to no task."""
METHODS_TITLE = "Methods"
TRIVIAL_TITLE = "Trivial baselines (not ranked)"
SUSPECT_TITLE = "Suspect: better than any method that has not seen the frames (not ranked)"
BELOW_TITLE = "Not better than a trivial baseline (not ranked)"
BELOW_CAUSES = (
    "Usual causes: tracking or masks that are off, a part of the person that no mesh explains, too short a training; see "
    "`headbench lint` and the pictures of textured-mesh, which shows what tracking alone is worth."
)
DECIDING = "psnr"
"""Metric by which a method is compared with trivial baselines; without it, the first one of frames."""
CONDITIONS_TITLE = "Under other conditions (not ranked)"


def build_table(
    runs: RunSet,
    metrics: Sequence[MetricSpec],
    tasks: Sequence[str],
    *,
    missing: Sequence[str] = (),
    avatar_title: str = AVATAR_TITLE,
    name: str = "",
) -> Table:
    """Build the comparison table of whole images of the methods of runs.

    A cell has a value only if every frame of the task has one, for every seed of the method, since means
    over different frames are not comparable. Otherwise it shows "–" or "failed", and a note gives the reason. Trivial baselines
    and methods under conditions (`RunSet.changed`) are listed separately and not ranked.

    ``metrics`` are the columns, in order; metrics of frames appear once in each of ``tasks``, the others last, below
    ``avatar_title``. ``missing`` are sentences for the caption, ``name`` is the layout.
    """
    rows, methods, trivial = runs.rows, runs.methods, runs.trivial
    rows.check_protocols("rows")
    places = [(m, task, TASK_TITLES.get(task, task)) for task in tasks for m in metrics if m.per_frame]
    places += [(m, "", avatar_title) for m in metrics if not m.per_frame]
    columns = tuple(
        Column(task, title, m.name, m.label, m.unit, m.digits, m.higher_is_better)
        for m, task, title in places
    )
    measured = conditions(rows, metrics, methods)
    mechanism_notes, off = mechanisms(rows, methods)
    time_notes = marks(measured, trivial)
    suspect_notes = suspects(rows, methods)
    below = not_better(rows, metrics, methods, trivial, tasks)
    titles = dict.fromkeys(methods, METHODS_TITLE)
    for title, names in (
        *((BELOW_TITLE, below), (SUSPECT_TITLE, {method for _, method, _ in suspect_notes})),
        *((TRIVIAL_TITLE, trivial), (CONDITIONS_TITLE, runs.changed)),
    ):
        titles |= {method: title for method in methods if method in names}
    unranked = {method for method, title in titles.items() if title != METHODS_TITLE}
    notes: list[str] = []
    lines: list[TableRow] = []
    for method in methods:
        cells = []
        for c in columns:
            note = suspect_notes.get((c.metric, method, c.task)) or time_notes.get((c.metric, method), "")
            note = mechanism_notes.get(method, "") if c.metric == DYNAMIC else note
            cells.append(_cell(summarise(rows, method, c.metric, c.task), c.digits, notes, note))
        lines.append(TableRow(method, ", ".join(rows.versions(method)), method in unranked, tuple(cells)))
    # Times measured under different conditions are not ranked, and mechanisms are different quantities.
    unequal = {metric for metric, method in time_notes if method not in unranked}
    unequal |= {spec.name for spec in metrics if spec.kind == "mechanism"}
    bests = [
        None if column.metric in unequal else _best(rows, lines, index, column)
        for index, column in enumerate(columns)
    ]
    lines = _ranked(lines, columns, bests)
    marking, starred = _marking(columns, lines, bests)
    groups = [
        (title, tuple(line for line in lines if titles[line.method] == title))
        for title in (METHODS_TITLE, BELOW_TITLE, SUSPECT_TITLE, CONDITIONS_TITLE, TRIVIAL_TITLE)
    ]
    return Table(
        columns=columns,
        groups=tuple((title, members) for title, members in groups if members),
        notes=tuple(notes),
        tasks=tuple(
            _task_summary(rows, task, runs.protocol_ids.get(task, ""), runs.keys.get(task, ()))
            for task in tasks
        ),
        seeds=max(1, len(rows.seeds(ALL))),
        warnings=(*((*below.values(), BELOW_CAUSES) if below else ()), *off),
        marking=marking,
        starred=starred,
        image_size=runs.image_size,
        cut=runs.cut,
        machine=measured_on(measured.get("fps", {}), trivial, runs.machine),
        part=runs.part,
        missing=tuple(missing),
        cameras=runs.cameras,
        averaged=runs.averaged,
        name=name,
        tested=any(best is not None and best.methods is not None for best in bests),
    )


def not_better(
    rows: Rows,
    metrics: Sequence[MetricSpec],
    methods: Sequence[str],
    trivial: Sequence[str],
    tasks: Sequence[str],
) -> dict[str, str]:
    """Sentences by method on those that are not better than a trivial baseline in some task."""
    sentences: dict[str, str] = {}
    # Conditions change the task, too.
    plain = [name for name in trivial if CONDITION_MARK not in name] or trivial
    spec = min((m for m in metrics if m.per_frame), key=lambda m: m.name != DECIDING, default=None)
    if spec is None:
        return {}
    sign = 1 if spec.higher_is_better else -1
    for task in tasks:
        values = {name: summarise(rows, name, spec.name, task).value for name in (*methods, *trivial)}
        floors = {name: sign * value for name in plain if (value := values[name]) is not None}
        best = max(floors, key=floors.__getitem__, default="")
        for name in methods if best else ():
            value = values[name]
            if name in (*trivial, *sentences) or value is None or sign * value > floors[best]:
                continue
            amounts = f"{value:.{spec.digits}f} against {values[best]:.{spec.digits}f} {spec.unit}".rstrip()
            where = TASK_TITLES.get(task, task).lower()
            sentences[name] = f"{name} is not better than {best} in {where}: {spec.label} {amounts}."
    return sentences


def _task_summary(rows: Rows, task: str, protocol_id: str, keys: Collection[FrameKey]) -> TaskSummary:
    frames: set[tuple[str, str, int, str]] = rows.frames(task, FULL)
    subjects = {key[0] for key in frames}
    frames |= {key for key in keys if key.subject not in subjects}  # subjects on which every method failed
    subjects = {key[0] for key in frames}
    title = TASK_TITLES.get(task, task)
    return TaskSummary(task, title, protocol_id, "".join(rows.protocols(task)), len(frames), len(subjects))


def _cell(aggregate: Aggregate, digits: int, notes: list[str], of_value: str) -> TableCell:
    """A cell; ``of_value`` is the note for its value, "" for none."""
    text = f"{aggregate.reason} {of_value}".strip() if aggregate.value is not None else aggregate.reason
    if text not in ("", *notes):
        notes.append(text)
    note = notes.index(text) if text else None
    if aggregate.value is not None:
        # One digit more than the value, since means differ less between seeds than between methods.
        spread = "" if aggregate.spread is None else f"{aggregate.spread:.{digits + 1}f}"
        return TableCell("ok", aggregate.value, f"{aggregate.value:.{digits}f}", spread, note=note)
    return TableCell(aggregate.status, None, "failed" if aggregate.status == "failed" else "–", note=note)


def _competing(lines: Sequence[TableRow], index: int) -> list[str]:
    """Methods that have a value in a column; trivial baselines are not ranked."""
    return [line.method for line in lines if not line.trivial and line.cells[index].status == "ok"]


def _best(rows: Rows, lines: Sequence[TableRow], index: int, column: Column) -> BestSet | None:
    """The methods that may be the best of a column; None if fewer than two have values."""
    names = _competing(lines, index)
    if len(names) < 2:
        return None
    means = {name: subject_means(whole_images(rows, name, column.metric, column.task)) for name in names}
    return best_set(means, higher_is_better=column.higher_is_better)


def _ranked(
    lines: Sequence[TableRow], columns: Sequence[Column], bests: Sequence[BestSet | None]
) -> list[TableRow]:
    """Rank each column: 1 for all that may be the best and all that are displayed equally, then by displayed value.

    Without a test, displayed values decide. Equal displayed values share a rank, and the next distinct one has the next.
    """
    cells = [list(line.cells) for line in lines]
    for index, (column, best) in enumerate(zip(columns, bests)):
        if best is None:
            continue
        competing = _competing(lines, index)
        values = {i: float(cells[i][index].text) for i, line in enumerate(lines) if line.method in competing}
        order = sorted(set(values.values()), reverse=column.higher_is_better)
        first = {value for i, value in values.items() if best.methods and lines[i].method in best.methods}
        first = first or {order[0]}
        others = [value for value in order if value not in first]
        for i, value in values.items():
            rank = 1 if value in first else others.index(value) + 2
            cells[i][index] = replace(cells[i][index], rank=rank)
    return [replace(line, cells=tuple(row)) for line, row in zip(lines, cells)]


def _marking(
    columns: Sequence[Column], lines: Sequence[TableRow], bests: Sequence[BestSet | None]
) -> tuple[str, str]:
    """Meaning of the marks of a table and their test, and the same where only the best have a mark, an asterisk; "" if nothing is ranked."""
    ranks = {cell.rank for line in lines for cell in line.cells}
    if not ranks - {None}:
        return "", ""
    tested = [best for best in bests if best is not None and best.methods is not None]
    untested = [(c, best) for c, best in zip(columns, bests) if best is not None and best.methods is None]
    places = ", ".join(["second underlined"] + ["third italic"] * (3 in ranks))
    counts = {counted(best.subjects, "subject") for best in tested or [best for _, best in untested]}
    subjects = " or ".join(sorted(counts))
    if not tested:
        needed = max(best.needed for _, best in untested)
        how = f"by the digits shown, without a test, which needs {needed} subjects (here {subjects})."
        return f"Best bold, {places}, {how}", f"* Best {how}"
    test = f"exact sign-flip test over {subjects}, each method against all others, Holm, {LEVEL:.0%}"
    best_of = f"very method that is not significantly worse than the best one, whatever its mean ({test})."
    others = f" The others by the digits shown: {places}."
    few = ""
    if untested:
        names = ", ".join(f"{column.title} {column.label}" for column, _ in untested)
        few = f" Too few subjects for a test, ranked by the digits alone: {names}."
    return f"Bold: e{best_of}{others}{few}", f"* E{best_of}{few}"


def compact(table: Table) -> Table:
    """Sort the rows of each group by the first column that has values, best first, and leave out columns without any.

    A column that is left out becomes a sentence in the caption, with its first reason. Columns in which a method failed
    are kept. Notes that no cell refers to are removed.
    """
    cells_of = [*zip(*(row.cells for row in table.rows))]
    kept = [
        i
        for i, cells in enumerate(cells_of)
        if any(c.value is not None or c.status == "failed" for c in cells)
    ]
    if not kept:
        return table
    left_out: dict[str, list[str]] = {}
    for index, column in enumerate(table.columns):
        if index not in kept:
            why = next((table.notes[c.note] for c in cells_of[index] if c.note is not None), "")
            left_out.setdefault(why, []).append(f"{column.title} {column.label}".strip())
    sentences = [
        f"No values of {', '.join(names)}{f': {why}' if why else ''}".rstrip(".") + "."
        for why, names in left_out.items()
    ]
    used: dict[int, int] = {}
    sign = -1 if table.columns[kept[0]].higher_is_better else 1

    def place(row: TableRow) -> float:
        value = row.cells[kept[0]].value
        return inf if value is None else sign * value

    def compacted(row: TableRow) -> TableRow:
        cells = (row.cells[index] for index in kept)
        notes = (
            (cell, None if cell.note is None else used.setdefault(cell.note, len(used))) for cell in cells
        )
        return replace(row, cells=tuple(replace(cell, note=note) for cell, note in notes))

    groups = [(title, tuple(map(compacted, sorted(rows, key=place)))) for title, rows in table.groups]
    return replace(
        table,
        columns=tuple(table.columns[index] for index in kept),
        groups=tuple(groups),
        notes=tuple(table.notes[note] for note in used),
        missing=(*table.missing, *sentences),
    )
