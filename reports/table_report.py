"""Tables by name: those for a run's metrics, and the layouts of the paper's tables.

The paper is "3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations"
(CVPR 2025, arXiv 2504.14967).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, cast

import pandas as pd

from ..bench.errors import InputError
from ..bench.io.documents import read_json
from ..bench.io.files import grouped_writes, write_text
from ..bench.manifest import MethodRecord
from ..bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from ..bench.registry import unknown
from ..bench.specs import MetricSpec
from ..bench.streams import on_terminal
from .cameras import SPLIT_TASK
from .runs import WHOLE, FrameSelection, RunSet
from .tables import AVATAR_TITLE, TITLES, RowGroup, Table, TableCell, TableRow, build_table
from .writers import WRITERS, column_name, to_text

NAMES = {
    "insta": "INSTA",
    "gha": "GaussianHeadAvatar",
    "gbs": "GaussianBlendshapes",
    "ga": "GaussianAvatars",
    "ours": "Ours",
}
"""Names of methods in papers, in the order of their tables."""

TASKS = ("novel_view", "self_reenactment")
QUALITY = {"psnr": 2, "ssim": 3, "lpips": 3}


class ComparedRuns(RunSet):
    """Finished runs on the same frames, as `read_runs` gives them; ``rows.select`` gives every number."""

    def table(self) -> pd.DataFrame:
        """The comparison table: a row for each method, a column for each (task, metric); metrics of no task are of "avatar".

        Values are means over frames, then sequences, subjects and seeds; not a number where one is missing.
        """
        metrics = [spec for spec in self.metrics if "comparison" in spec.tables]
        runs = self.by_camera
        built = build_table(
            runs.rows, metrics, self.methods, runs.tasks, trivial=self.trivial, protocol_ids=self.protocol_ids
        )
        columns = pd.MultiIndex.from_tuples(
            [(column.task or "avatar", column.metric) for column in built.columns], names=["task", "metric"]
        )
        values = [[cell.value for cell in row.cells] for row in built.rows]
        methods = pd.Index([row.method for row in built.rows], name="method")
        return pd.DataFrame(values, methods, columns, dtype=float)


def read_runs(folders: Path | str | Sequence[Path | str]) -> ComparedRuns:
    """Read finished runs on the same frames.

    Parameters
    ----------
    folders : Path | str | Sequence[Path | str]
        One run folder or several. Seeds of the same method with the same settings are merged.

    Raises
    ------
    InputError
        A folder is not a finished run, or the runs score different frames or protocols.
    """
    several = [folders] if isinstance(folders, (str, Path)) else folders
    return cast(ComparedRuns, ComparedRuns.read([Path(folder) for folder in several]))


@dataclass(frozen=True)
class Columns:
    """Selection of a layout's metrics and tasks by ``names`` (none of a kind named: all of it), and digits.

    ``digits`` are numbers of decimals, as "3" for every metric and "psnr=1" for one.
    """

    names: tuple[str, ...] = ()
    digits: tuple[str, ...] = ()

    def of(self, offered: Iterable[str]) -> tuple[str, ...]:
        """The requested names among ``offered``, in the requested order."""
        names = tuple(offered)
        return tuple(dict.fromkeys(name for name in self.names if name in names)) or names

    def by_camera(self, tasks: Collection[str]) -> Columns:
        """The same for ``tasks`` among which self-reenactment is two; its name stands for both."""
        if SPLIT_TASK not in self.names or SPLIT_TASK in tasks:
            return self
        parts = {SPLIT_TASK: tuple(task for task in (SEEN_CAMERAS, UNSEEN_CAMERAS) if task in tasks)}
        return replace(self, names=tuple(n for name in self.names for n in parts.get(name) or (name,)))

    def check(self, metrics: Iterable[str], tasks: Iterable[str]) -> None:
        """Raise `InputError` for a name that is neither a metric nor a task of the layout, and for digits that are no numbers from 0 to 9."""
        metrics = tuple(metrics)
        for name in self.names:
            if name not in (*metrics, *tasks):
                raise unknown("command line", "--columns", name, (*metrics, *tasks))
        for metric in self._decimals:
            if metric not in ("", *metrics):
                raise unknown("command line", "--digits", metric, metrics)

    def shown(self, spec: MetricSpec) -> MetricSpec:
        """A metric with the requested digits."""
        decimals = self._decimals
        return replace(spec, digits=decimals.get(spec.name, decimals.get("", spec.digits)))

    @property
    def _decimals(self) -> dict[str, int]:
        """Digits by metric, "" for all others."""
        found = {}
        for word in self.digits:
            metric, _, number = word.rpartition("=")
            if not re.fullmatch("([^=]+=)?[0-9]", word):
                raise InputError("command line", "--digits", "N or METRIC=N with N from 0 to 9", word)
            found[metric] = int(number)
        return found


ALL_COLUMNS = Columns()


@dataclass(frozen=True)
class PaperLayout:
    """A table of the paper: ``digits`` of each metric, in the order of the columns, and ``methods``, () for all."""

    summary: str
    digits: Mapping[str, int] = field(default_factory=lambda: {**QUALITY, "storage": 1, "fps": 0})
    methods: tuple[str, ...] = ()

    def metrics(self, runs: RunSet, name: str, columns: Columns) -> tuple[MetricSpec, ...]:
        """The metrics shown. Raises `InputError` if the runs lack a requested metric or task."""
        known = {spec.name: spec for spec in runs.metrics}
        digits = {metric: self.digits[metric] for metric in columns.of(self.digits)}
        for what, wanted, there in (("metrics", digits, known), ("tasks", columns.of(TASKS), runs.tasks)):
            if not set(wanted) <= set(there):
                expected, found = ", ".join(wanted), ", ".join(there)
                raise InputError(runs.runs[0].folder.root, f"{what} of layout {name}", expected, found)
        return tuple(replace(known[metric], digits=number) for metric, number in digits.items())

    def labels(self, runs: RunSet, name: str) -> dict[str, str]:
        """Rows: labels of methods and how the paper writes them, in its order; without trivial baselines."""
        own = {label: runs.records[label].name for label in runs.ranked}
        own = {label: method for label, method in own.items() if not self.methods or method in self.methods}
        if not own:
            found = ", ".join(runs.methods)
            raise InputError(runs.runs[0].folder.root, f"layout {name}", ", ".join(self.methods), found)
        # Methods that no table of the paper has come before "ours", which is last.
        order = [*(method for method in NAMES if method != "ours"), None, "ours"]
        place = {method: order.index(method if method in order else None) for method in own.values()}
        return {
            label: NAMES.get(method, method) + label.removeprefix(method)
            for label, method in sorted(own.items(), key=lambda item: place[item[1]])
        }


PAPER: Mapping[str, PaperLayout] = {
    "paper-1": PaperLayout("every method: both tasks' quality, storage, speed"),
    "paper-3": PaperLayout("INSTA and ours: both tasks' quality, storage, speed", methods=("insta", "ours")),
    "paper-4": PaperLayout(
        "settings of the method ours, one run each: both tasks' quality", QUALITY, ("ours",)
    ),
}


FILE = Path(__file__).with_name("published.json")


@dataclass(frozen=True)
class PublishedRow:
    """A row of a paper's table: its source, its data, and the layout that it belongs to.

    A measured method is the same with this name and these ``settings``, by dotted name. ``values`` are as printed,
    by ``task/metric``.
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

        def setting(name: str) -> Any:
            value: Any = record.config
            for part in name.split("."):
                value = value.get(part) if isinstance(value, Mapping) else None
            return value

        return record.name == self.method and all(setting(n) == value for n, value in self.settings.items())


@cache
def published_rows() -> tuple[tuple[PublishedRow, str], ...]:
    """All rows, each with its source in words."""
    content = read_json(FILE)
    rows = [PublishedRow(**entry) for entry in content["figures"]]
    return tuple((row, content["sources"][row.source]) for row in rows)


def with_published(table: Table, layout: str, records: Mapping[str, MethodRecord]) -> Table:
    """Add a column "published" after each measured one for which a paper's table of this layout has a value.

    ``records`` has the manifest entries of the table's methods by label.
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

    def with_figures(row: TableRow) -> TableRow:
        values, note = figures.get(row.method, ({}, 0))
        cells = []
        for column, cell, beside in zip(table.columns, row.cells, shown):
            cells.append(cell)
            if beside:
                text = values.get(column_name(column))
                none = TableCell("none", None, "")
                cells.append(none if text is None else TableCell("published", float(text), text, note=note))
        return replace(row, cells=tuple(cells))

    return replace(table.mapped(with_figures), columns=tuple(columns), notes=tuple(notes))


COMPARISON = "comparison"


def write_tables(run_folder: Path) -> list[Path]:
    """Write every table for a run's metrics, in every format, into its folder of tables; return the files."""
    runs = RunSet.read([run_folder])
    files = []
    for layout in layouts(runs):
        table = table_of(runs, layout)
        with grouped_writes():
            for suffix, write in WRITERS.values():
                path = runs.runs[0].folder.tables / f"{layout}.{suffix}"
                write_text(path, write(table))
                files.append(path)
    return files


def table_text(
    run_folders: Sequence[Path],
    format: str | None = None,
    layout: str = COMPARISON,
    published: bool = False,
    region: str = WHOLE.region,
    sequences: tuple[str, ...] = (),
    columns: tuple[str, ...] = (),
    digits: tuple[str, ...] = (),
) -> str:
    """Return a table of one or more runs as text, in a format of `WRITERS` or as "text", which has aligned columns.

    Without a format it is "text" if standard output is a terminal, else "md".
    ``published`` adds columns with the figures that papers printed; ``region`` and ``sequences`` are those of `FrameSelection`,
    ``columns`` and ``digits`` those of `Columns`. Raises `InputError` for a format, a layout, columns or runs that do not fit.
    """
    styled = format is None and on_terminal()
    format = format or ("text" if styled else "md")
    if format not in (*WRITERS, "text"):
        raise InputError("table", "format", f"one of {', '.join(WRITERS)}, text", repr(format))
    runs = RunSet.read(run_folders, FrameSelection(region, sequences))
    known = (*layouts(runs), *PAPER)
    if layout not in known:
        raise InputError(run_folders[0], "layout", f"one of {', '.join(known)}", repr(layout))
    table = table_of(runs, layout, published, Columns(columns, digits))
    return to_text(table, styled=styled) if format == "text" else WRITERS[format][1](table)


def layouts(runs: RunSet) -> tuple[str, ...]:
    """Names of the tables for the runs' metrics; the comparison is always included, and first."""
    asked = [table for metric in runs.metrics for table in metric.tables]
    return tuple(dict.fromkeys([COMPARISON, *asked]))


def table_of(
    runs: RunSet,
    layout: str = COMPARISON,
    published: bool = False,
    columns: Columns = ALL_COLUMNS,
    apart: Sequence[RowGroup] = (),
    claimed: Collection[tuple[str, str]] = (),
) -> Table:
    """Build a table of runs that were read; ``apart`` and ``claimed`` are those of `build_table`."""
    names = {label: label for label in runs.methods}
    if layout in PAPER:  # whose tables have the mean over all cameras
        columns.check(PAPER[layout].digits, TASKS)
        metrics = PAPER[layout].metrics(runs, layout, columns)
        names = PAPER[layout].labels(runs, layout)
    else:
        runs = runs.by_camera
        columns = columns.by_camera(runs.tasks)
        known = {metric.name: metric for metric in runs.metrics if layout in metric.tables}
        columns.check(known, runs.tasks if any(metric.per_frame for metric in known.values()) else ())
        metrics = tuple(known[name] for name in columns.of(known))
    metrics = tuple(map(columns.shown, metrics))
    # A table without metrics of frames has no task.
    tasks = columns.of(runs.tasks) if any(metric.per_frame for metric in metrics) else ()
    if not tasks and set(columns.names) & set(runs.tasks):
        found = ", ".join(columns.names)
        raise InputError("command line", "--columns", "a metric of frames beside a task", found)
    table = build_table(
        runs.rows,
        metrics,
        list(names),
        tasks,
        trivial=runs.trivial,
        changed=runs.changed,
        protocol_ids=runs.protocol_ids,
        image_size=runs.image_size,
        machine=runs.machine,
        part=runs.part if tasks else "",
        missing=runs.missing if tasks == runs.tasks else (),
        cameras=runs.cameras if {SPLIT_TASK, SEEN_CAMERAS, UNSEEN_CAMERAS} & {*tasks} else "",
        keys=runs.keys,
        avatar_title=TITLES.get(layout, AVATAR_TITLE),
        name=layout,
        apart=apart,
        claimed=claimed,
    )
    if published:
        table = with_published(table, layout, runs.records)
        if not table.has_published:
            found = f"none for {', '.join(names)} in layout {layout}"
            raise InputError("table", "--published", "a layout with figures that papers printed", found)
    return table.mapped(lambda row: replace(row, method=names[row.method]))
