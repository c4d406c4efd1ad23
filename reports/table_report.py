"""Named tables of runs as text: tables for a run's metrics, and tables in the form of published ones."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, cast

import tyro

from ..bench.contracts import Progress
from ..bench.engine.store import FinishedRun
from ..bench.errors import InputError
from ..bench.io.files import check_writable, write_text
from ..bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from ..bench.registry import unknown
from ..bench.specs import CommandResult, MetricSpec, command
from .runs import SPLIT_TASK, WHOLE, FrameSelection, RunSet
from .tables import AVATAR_TITLE, COMPARISON, TITLES, Table, build_table
from .writers import WRITERS, to_text

if TYPE_CHECKING:
    import pandas as pd

Format: TypeAlias = Literal["text", "md", "csv", "latex", "html", "json"]


@dataclass(frozen=True)
class TableSettings:
    """Runs are merged into one table: seeds of the same settings are averaged, other settings get separate rows."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of the runs."""
    format: Format | None = None
    """Aligned columns, Markdown, CSV, LaTeX (booktabs), a page of HTML, or JSON. Default: by the suffix of --out; without
    it text."""
    details: bool = False
    """With text: also the protocols with their hashes, and how values were averaged."""
    layout: str = "comparison"
    """Which table: comparison, speed (latency, throughput, stages) or cost (storage, training)."""
    paper: Annotated[str | None, tyro.conf.arg(name="as")] = None
    """Paper (`headbench list papers`) in whose table layout the runs are shown, with the rows of the paper below."""
    number: Annotated[str | None, tyro.conf.arg(name="table")] = None
    """With --as: the number of the table. Default: all that were read in full, or quoted in full texts."""
    protocol: str | None = None
    """Published protocol by which frames, pixels, metrics and means are chosen from the rows: a name of `headbench list protocols`."""
    region: str = "full"
    """Region to show instead of the whole frame, such as face."""
    sequences: tuple[str, ...] = ()
    """Only frames of these sequences; default: all."""
    columns: tuple[str, ...] = ()
    """Only these metrics and tasks of the layout, by name and in this order, such as `psnr novel_view`; default: all."""
    digits: tuple[str, ...] = ()
    """Decimals shown, of all metrics or of one: `3`, `psnr=1 lpips=4`. Default: the layout's."""
    out: str | None = None
    """File to write the table to, instead of printing it."""


SUFFIXES: dict[str, Format] = {
    ".md": "md",
    ".txt": "text",
    ".tex": "latex",
    ".html": "html",
    ".csv": "csv",
    ".json": "json",
}
"""Formats of tables by the suffix of a file."""


@command("table", group="compare")
def print_table(settings: TableSettings, progress: Progress) -> CommandResult:
    """Print a table of finished runs on the same frames, or write it to a file."""
    out = settings.out
    suffix = "" if out is None else Path(out).suffix.lower()
    if out is not None:
        check_writable(Path(out), "--out")
        if settings.format is None and suffix not in SUFFIXES:
            expected = f"a suffix that names a format ({', '.join(SUFFIXES)}), or --format"
            raise InputError("command line", "--out", expected, out)
    form = settings.format or SUFFIXES.get(suffix, "text")
    if settings.details and form != "text":
        raise InputError("command line", "--details", "text, to which it adds", form)
    tables = tables_of([Path(run) for run in settings.runs], replace(settings, format=form))
    text = written(tables, form, details=settings.details)
    data = {"format": form, "table": text}
    if out is not None:
        write_text(Path(out), text)
        return CommandResult(out, {**data, "out": out})
    if form == "text":
        text = written(tables, form, details=settings.details, fit=True)
    return CommandResult(text, data, verbatim=form != "text")


class ComparedRuns(RunSet):
    """Finished runs on the same frames, returned by `read_runs`; ``rows.select`` returns single values."""

    def table(self) -> pd.DataFrame:
        """The comparison table: a row per method, a column per (task, metric); the task of avatar metrics is "avatar".

        Values are means over frames, then sequences, subjects and seeds; NaN if one is missing.
        """
        import pandas as pd

        metrics = [spec for spec in self.metrics if COMPARISON in spec.tables]
        runs = self.by_camera
        table = build_table(runs.without_conditions, metrics, runs.tasks)
        names = [(column.task or "avatar", column.metric) for column in table.columns]
        columns = pd.MultiIndex.from_tuples(names, names=["task", "metric"])
        values = [[cell.value for cell in row.cells] for row in table.rows]
        methods = pd.Index([row.method for row in table.rows], name="method")
        return pd.DataFrame(values, methods, columns, dtype=float)


def read_runs(folders: Path | str | Sequence[Path | str]) -> ComparedRuns:
    """Read finished runs on the same frames from one or more folders. Seeds of the same method with the same settings are merged."""
    paths = [folders] if isinstance(folders, (str, Path)) else folders
    return cast(ComparedRuns, ComparedRuns.read([Path(folder) for folder in paths]))


@dataclass(frozen=True)
class Columns:
    """Selected metrics and tasks of a layout (``names``; all if none of a kind is named), and digits.

    ``digits`` are numbers of decimals, such as "3" for all metrics or "psnr=1" for one.
    """

    names: tuple[str, ...] = ()
    digits: tuple[str, ...] = ()

    def of(self, offered: Collection[str]) -> tuple[str, ...]:
        """The requested names among ``offered``, in the requested order; all if there are none."""
        return tuple(dict.fromkeys(name for name in self.names if name in offered)) or tuple(offered)

    def by_camera(self, tasks: Collection[str]) -> Columns:
        """This selection for ``tasks`` with self-reenactment split in two; its name selects both."""
        if SPLIT_TASK not in self.names or SPLIT_TASK in tasks:
            return self
        parts = {SPLIT_TASK: tuple(task for task in (SEEN_CAMERAS, UNSEEN_CAMERAS) if task in tasks)}
        return replace(self, names=tuple(n for name in self.names for n in parts.get(name) or (name,)))

    def metrics(self, of_layout: Mapping[str, MetricSpec], tasks: Collection[str]) -> tuple[MetricSpec, ...]:
        """The requested metrics of a layout, with the requested digits; `InputError` for names that it does not have."""
        for name in self.names:
            if name not in (*of_layout, *tasks):
                raise unknown("command line", "--columns", name, (*of_layout, *tasks))
        decimals: dict[str, int] = {}  # by metric, "" for all others
        for word in self.digits:
            metric, _, number = word.rpartition("=")
            if not re.fullmatch("([^=]+=)?[0-9]", word):
                raise InputError("command line", "--digits", "N or METRIC=N with N from 0 to 9", word)
            decimals[metric] = int(number)
        for metric in decimals:
            if metric not in ("", *of_layout):
                raise unknown("command line", "--digits", metric, tuple(of_layout))
        specs = (of_layout[name] for name in self.of(of_layout))
        return tuple(replace(s, digits=decimals.get(s.name, decimals.get("", s.digits))) for s in specs)


ALL_COLUMNS = Columns()


def write_tables(run: Path | FinishedRun) -> list[Path]:
    """Write every table for a run's metrics, in every format, into its folder of tables; return the files."""
    runs = RunSet.read([run])
    files = []
    for layout in layouts(runs):
        table = table_of(runs, layout)
        for suffix, write in WRITERS.values():
            path = runs.runs[0].folder.tables / f"{layout}.{suffix}"
            write_text(path, write(table))
            files.append(path)
    return files


def table_text(
    run_folders: Sequence[Path | FinishedRun],
    format: Format = "text",
    layout: str = COMPARISON,
    *,
    fit: bool = False,
    **selection: Any,
) -> str:
    """A table of one or more runs; ``fit`` is that of `to_text`, ``selection`` are other `TableSettings`."""
    settings = TableSettings((), format=format, layout=layout, **selection)
    return written(tables_of(run_folders, settings), format, details=settings.details, fit=fit)


def written(tables: Iterable[Table], format: str, *, details: bool = False, fit: bool = False) -> str:
    """Tables in a format, below each other."""
    write = partial(to_text, details=details, fit=fit) if format == "text" else WRITERS[format][1]
    return "\n".join(map(write, tables))


def tables_of(run_folders: Sequence[Path | FinishedRun], settings: TableSettings) -> list[Table]:
    """Build the requested table of runs, or the tables of a paper; runs of the settings are ignored."""
    if settings.format not in (*WRITERS, "text"):
        raise InputError("table", "format", f"one of {', '.join(WRITERS)}, text", repr(settings.format))
    part = FrameSelection(settings.region, settings.sequences)
    if settings.protocol is not None and part != WHOLE:
        expected = "no --region or --sequences beside it, which it decides"
        raise InputError("command line", "--protocol", expected, part.text)
    runs = RunSet.read(run_folders, part)
    if settings.protocol is not None:
        from ..bench.protocol import protocol_named
        from .protocols import under

        runs = under(runs, settings.protocol, protocol_named(settings.protocol))
    columns, layout = Columns(settings.columns, settings.digits), settings.layout
    if settings.paper is None:
        if settings.number is not None:
            raise InputError("command line", "--table", "--as PAPER beside it", "no paper")
        names = layouts(runs)
        if layout not in names:
            raise InputError(runs.runs[0].folder.root, "layout", f"one of {', '.join(names)}", repr(layout))
        return [table_of(runs, layout, columns)]
    if columns != ALL_COLUMNS or layout != COMPARISON:
        expected = "no --layout, --columns or --digits beside it: a printed table has its own"
        raise InputError("command line", "--as", expected, "one of them")
    from .papers import as_printed, printed_tables

    printed = printed_tables(settings.paper, settings.number)
    if len(printed) > 1 and settings.format not in ("text", "md", "latex"):
        names = tuple(table.table for table in printed)
        expected = f"one of {', '.join(names)}, for a file of format {settings.format}"
        raise InputError("command line", "--table", expected, "none")
    return [as_printed(runs, settings.paper, table) for table in printed]


def layouts(runs: RunSet) -> tuple[str, ...]:
    """Names of the tables for the runs' metrics; the comparison is always included, and first."""
    return tuple(dict.fromkeys([COMPARISON, *(name for metric in runs.metrics for name in metric.tables)]))


def table_of(runs: RunSet, layout: str = COMPARISON, columns: Columns = ALL_COLUMNS) -> Table:
    """Build a table of loaded runs. Avatar metrics of other layouts are shown if ``columns`` names them."""
    runs = runs.by_camera
    columns = columns.by_camera(runs.tasks)
    of_layout = {
        m.name: m for m in runs.metrics if layout in m.tables or (m.name in columns.names and not m.per_frame)
    }
    of_frames = any(metric.per_frame for metric in of_layout.values())
    metrics = columns.metrics(of_layout, runs.tasks if of_frames else ())
    # A table without frame metrics has no task.
    tasks = columns.of(runs.tasks) if any(metric.per_frame for metric in metrics) else ()
    if not tasks and set(columns.names) & set(runs.tasks):
        expected = "a metric of frames beside a task"
        raise InputError("command line", "--columns", expected, ", ".join(columns.names))
    runs = replace(
        runs,
        part=runs.part if tasks else "",
        cameras=runs.cameras if {SPLIT_TASK, SEEN_CAMERAS, UNSEEN_CAMERAS} & {*tasks} else "",
    )
    return build_table(
        runs,
        metrics,
        tasks,
        missing=(*(runs.missing if tasks == runs.tasks else ()), *runs.remarks),
        avatar_title=TITLES.get(layout, AVATAR_TITLE),
        name=layout,
    )
