"""The tables of finished runs, as files or as text: the comparison, those of costs, the paper's layouts."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from ..bench.errors import InputError
from ..bench.io.files import grouped_writes, write_text
from .csv_table import to_csv
from .html_table import to_html
from .latex import to_latex
from .layouts import PAPER
from .markdown import to_markdown
from .published import with_published
from .run_set import RunSet
from .table_model import Table
from .tables import AVATAR_TITLE, build_table


def to_json(table: Table) -> str:
    """Write the typed table as it is."""
    return json.dumps({**asdict(table), "caption": table.caption}, indent=1, ensure_ascii=False) + "\n"


WRITERS: dict[str, tuple[str, Callable[[Table], str]]] = {
    "md": ("md", to_markdown),
    "csv": ("csv", to_csv),
    "latex": ("tex", to_latex),
    "html": ("html", to_html),
    "json": ("json", to_json),
}
COMPARISON = "comparison"
TITLES = {"speed": "Speed", "cost": "Storage and training"}


def write_tables(run_folder: Path) -> list[Path]:
    """Write every table that a run's metrics ask for, in every format, into its folder of tables; return the files."""
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
    run_folders: Sequence[Path], format: str = "md", layout: str = COMPARISON, published: bool = False
) -> str:
    """Return a table of one or more runs as text, in a format of `WRITERS`.

    ``published`` adds columns with the figures that papers printed. Raises `InputError` for a format, a layout or
    runs that do not fit.
    """
    if format not in WRITERS:
        raise InputError("table", "format", f"one of {', '.join(WRITERS)}", repr(format))
    runs = RunSet.read(run_folders)
    if layout not in (*layouts(runs), *PAPER):
        raise InputError(
            run_folders[0], "layout", f"one of {', '.join((*layouts(runs), *PAPER))}", repr(layout)
        )
    _, write = WRITERS[format]
    return write(table_of(runs, layout, published))


def layouts(runs: RunSet) -> tuple[str, ...]:
    """Names of the tables that the runs' metrics ask for; the comparison is always there, and first."""
    asked = [table for metric in runs.metrics for table in metric.tables]
    return tuple(dict.fromkeys([COMPARISON, *asked]))


def table_of(runs: RunSet, layout: str = COMPARISON, published: bool = False) -> Table:
    """Build a table of runs that were read."""
    names = {label: label for label in runs.methods}
    if layout in PAPER:
        metrics = PAPER[layout].metrics(runs, layout)
        names = PAPER[layout].labels(runs, layout)
    else:
        metrics = tuple(metric for metric in runs.metrics if layout in metric.tables)
    # A table without frames' metrics is about no task.
    tasks = runs.tasks if any(metric.per_frame for metric in metrics) else ()
    table = build_table(
        runs.rows,
        metrics,
        list(names),
        trivial=runs.trivial,
        tasks=tasks,
        protocol_ids=runs.protocol_ids,
        image_size=runs.image_size,
        machine=runs.machine,
        avatar_title=TITLES.get(layout, AVATAR_TITLE),
    )
    if published:
        table = with_published(table, layout, runs.records)
        if not any(column.published for column in table.columns):
            found = f"none for {', '.join(names)} in layout {layout}"
            raise InputError("table", "--published", "a layout with figures that papers printed", found)
    return _renamed(table, names)


def _renamed(table: Table, names: dict[str, str]) -> Table:
    """Write methods as a layout does."""
    groups = tuple(
        (title, tuple(replace(row, method=names[row.method]) for row in rows)) for title, rows in table.groups
    )
    return replace(table, groups=groups)
