"""Named tables of runs as text: tables for a run's metrics, and tables in the form of published ones."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import pandas as pd
import tyro

from ..bench.contracts import Progress
from ..bench.engine.store import FinishedRun
from ..bench.errors import InputError
from ..bench.io.files import (
    check_writable,
    write_text,
)
from ..bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from ..bench.registry import unknown
from ..bench.specs import CommandResult, MetricSpec, command
from .runs import SPLIT_TASK, WHOLE, FrameSelection, RunSet
from .tables import AVATAR_TITLE, COMPARISON, TITLES, Table, build_table
from .writers import WRITERS, to_text


@dataclass(frozen=True)
class TableSettings:
    """Runs are merged into one table: seeds of the same settings are averaged, other settings get separate rows."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of the runs."""
    format: Literal["text", "md", "csv", "latex", "html", "json"] | None = None
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


SUFFIXES = {".md": "md", ".txt": "text", ".tex": "latex", ".html": "html", ".csv": "csv", ".json": "json"}
"""Formats of tables by the suffix of a file."""


@command("table", group="compare")
def print_table(settings: TableSettings, progress: Progress) -> CommandResult:
    """Print a table of finished runs on the same frames, or write it to a file."""
    selection = asdict(settings)
    out, details = selection.pop("out"), selection.pop("details")
    suffix = "" if out is None else Path(out).suffix.lower()
    if out is not None:
        check_writable(Path(out), "--out")
        if settings.format is None and suffix not in SUFFIXES:
            expected = f"a suffix that names a format ({', '.join(SUFFIXES)}), or --format"
            raise InputError("command line", "--out", expected, out)
    form = selection["format"] = settings.format or SUFFIXES.get(suffix, "text")
    if details and form != "text":
        raise InputError("command line", "--details", "text, to which it adds", form)
    tables = tables_of([Path(run) for run in selection.pop("runs")], **selection)
    text = written(tables, form, details=details)
    data = {"format": form, "table": text}
    if out is not None:
        write_text(Path(out), text)
        return CommandResult(out, {**data, "out": out})
    if form == "text":
        text = written(tables, form, details=details, fit=True)
    return CommandResult(text, data, verbatim=form != "text")


class ComparedRuns(RunSet):
    """Finished runs on the same frames, returned by `read_runs`; ``rows.select`` returns single values."""

    def table(self) -> pd.DataFrame:
        """The comparison table: a row per method, a column per (task, metric); the task of avatar metrics is "avatar".

        Values are means over frames, then sequences, subjects and seeds; NaN if one is missing.
        """
        metrics = [spec for spec in self.metrics if "comparison" in spec.tables]
        runs = self.by_camera
        built = build_table(runs.without_conditions, metrics, runs.tasks)
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
        One or more run folders. Seeds of the same method with the same settings are merged.

    Raises
    ------
    InputError
        A folder is not a finished run, or the runs score different frames or protocols.
    """
    several = [folders] if isinstance(folders, (str, Path)) else folders
    return cast(ComparedRuns, ComparedRuns.read([Path(folder) for folder in several]))


@dataclass(frozen=True)
class Columns:
    """Selected metrics and tasks of a layout (``names``; all if none of a kind is named), and digits.

    ``digits`` are numbers of decimals, such as "3" for all metrics or "psnr=1" for one.
    """

    names: tuple[str, ...] = ()
    digits: tuple[str, ...] = ()

    def of(self, offered: Iterable[str]) -> tuple[str, ...]:
        """The requested names among ``offered``, in the requested order."""
        names = tuple(offered)
        return tuple(dict.fromkeys(name for name in self.names if name in names)) or names

    def by_camera(self, tasks: Collection[str]) -> Columns:
        """This selection for ``tasks`` with self-reenactment split in two; its name selects both."""
        if SPLIT_TASK not in self.names or SPLIT_TASK in tasks:
            return self
        parts = {SPLIT_TASK: tuple(task for task in (SEEN_CAMERAS, UNSEEN_CAMERAS) if task in tasks)}
        return replace(self, names=tuple(n for name in self.names for n in parts.get(name) or (name,)))

    def check(self, metrics: Iterable[str], tasks: Iterable[str]) -> None:
        """Raise `InputError` for names that are no metric or task of the layout, and digits that are no numbers from 0 to 9."""
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
    format: str = "text",
    layout: str = COMPARISON,
    *,
    details: bool = False,
    fit: bool = False,
    **selection: Any,
) -> str:
    """Return a table of one or more runs in a format of `WRITERS` or as "text", aligned columns.

    ``details`` and ``fit`` are those of `to_text`, ``selection`` that of `tables_of`, which raises `InputError`.
    """
    tables = tables_of(run_folders, format, layout, **selection)
    return written(tables, format, details=details, fit=fit)


def written(tables: Iterable[Table], format: str, *, details: bool = False, fit: bool = False) -> str:
    """Tables in a format, below each other."""
    write = partial(to_text, details=details, fit=fit) if format == "text" else WRITERS[format][1]
    return "\n".join(map(write, tables))


def tables_of(
    run_folders: Sequence[Path | FinishedRun],
    format: str,
    layout: str = COMPARISON,
    paper: str | None = None,
    number: str | None = None,
    protocol: str | None = None,
    region: str = WHOLE.region,
    sequences: tuple[str, ...] = (),
    columns: tuple[str, ...] = (),
    digits: tuple[str, ...] = (),
) -> list[Table]:
    """Build the table of runs, or the tables of a paper, for a format.

    ``paper`` names one of `papers`; the runs are shown in the form of its tables, or of the table ``number``, instead of a
    layout. ``protocol`` names one of `named_protocols`, which selects frames, pixels and metrics; ``region`` and ``sequences``
    are those of `FrameSelection`, ``columns`` and ``digits`` those of `Columns`. Raises `InputError` for invalid combinations.
    """
    if format not in (*WRITERS, "text"):
        raise InputError("table", "format", f"one of {', '.join(WRITERS)}, text", repr(format))
    part = FrameSelection(region, sequences)
    if protocol is not None and part != WHOLE:
        expected = "no --region or --sequences beside it, which it decides"
        raise InputError("command line", "--protocol", expected, part.text)
    runs = RunSet.read(run_folders, part)
    if protocol is not None:
        from ..bench.named_protocol import protocol_named
        from .protocols import under

        runs = under(runs, protocol, protocol_named(protocol))
    if paper is None:
        if number is not None:
            raise InputError("command line", "--table", "--as PAPER beside it", "no paper")
        known = layouts(runs)
        if layout not in known:
            raise InputError(runs.runs[0].folder.root, "layout", f"one of {', '.join(known)}", repr(layout))
        return [table_of(runs, layout, Columns(columns, digits))]
    if columns or digits or layout != COMPARISON:
        expected = "no --layout, --columns or --digits beside it: a printed table has its own"
        raise InputError("command line", "--as", expected, "one of them")
    from .papers import as_printed, printed_tables

    printed = printed_tables(paper, number)
    if len(printed) > 1 and format not in ("text", "md", "latex"):
        expected = f"one of {', '.join(table.table for table in printed)}, for a file of format {format}"
        raise InputError("command line", "--table", expected, "none")
    return [as_printed(runs, paper, table) for table in printed]


def layouts(runs: RunSet) -> tuple[str, ...]:
    """Names of the tables for the runs' metrics; the comparison is always included, and first."""
    asked = [table for metric in runs.metrics for table in metric.tables]
    return tuple(dict.fromkeys([COMPARISON, *asked]))


def table_of(
    runs: RunSet,
    layout: str = COMPARISON,
    columns: Columns = ALL_COLUMNS,
) -> Table:
    """Build a table of loaded runs.

    Avatar metrics of other layouts are shown if ``columns`` names them.
    """
    runs = runs.by_camera
    columns = columns.by_camera(runs.tasks)
    known = {
        m.name: m for m in runs.metrics if layout in m.tables or (m.name in columns.names and not m.per_frame)
    }
    columns.check(known, runs.tasks if any(metric.per_frame for metric in known.values()) else ())
    metrics = tuple(known[name] for name in columns.of(known))
    metrics = tuple(map(columns.shown, metrics))
    # A table without frame metrics has no task.
    tasks = columns.of(runs.tasks) if any(metric.per_frame for metric in metrics) else ()
    if not tasks and set(columns.names) & set(runs.tasks):
        found = ", ".join(columns.names)
        raise InputError("command line", "--columns", "a metric of frames beside a task", found)
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
