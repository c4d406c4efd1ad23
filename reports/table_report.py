"""The tables of a run folder, as files or as text: the comparison, and those of what avatars cost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..bench.errors import InputError
from ..bench.files import write_text
from .csv_table import to_csv
from .latex import to_latex
from .markdown import to_markdown
from .run_data import RunData
from .tables import AVATAR_TITLE, Table, build_table

WRITERS: dict[str, tuple[str, Callable[[Table], str]]] = {
    "md": ("md", to_markdown),
    "csv": ("csv", to_csv),
    "latex": ("tex", to_latex),
}
COMPARISON = "comparison"
TITLES = {"speed": "Speed", "cost": "Storage and training"}


def write_tables(run_folder: Path) -> list[Path]:
    """Write every table of a run in every format into its folder of tables; return the files."""
    data = RunData.read(run_folder)
    files = []
    for layout in layouts(data):
        table = table_of(data, layout)
        for suffix, write in WRITERS.values():
            path = data.folder.tables / f"{layout}.{suffix}"
            write_text(path, write(table))
            files.append(path)
    return files


def table_text(run_folder: Path, format: str = "md", layout: str = COMPARISON) -> str:
    """Return a table of a run as text: "md", "csv" or "latex". Raises `InputError` for one that it does not have."""
    if format not in WRITERS:
        raise InputError("table", "format", f"one of {', '.join(WRITERS)}", repr(format))
    data = RunData.read(run_folder)
    if layout not in layouts(data):
        raise InputError(run_folder, "layout", f"one of {', '.join(layouts(data))}", repr(layout))
    _, write = WRITERS[format]
    return write(table_of(data, layout))


def layouts(data: RunData) -> tuple[str, ...]:
    """Names of the tables that the run's metrics ask for; the comparison is always there, and first."""
    asked = [table for metric in data.metrics for table in metric.tables]
    return tuple(dict.fromkeys([COMPARISON, *asked]))


def table_of(data: RunData, layout: str = COMPARISON) -> Table:
    """Build a table of a run that was read."""
    metrics = [metric for metric in data.metrics if layout in metric.tables]
    # A table without frames' metrics is about no task.
    tasks = data.tasks if any(metric.per_frame for metric in metrics) else ()
    return build_table(
        data.rows,
        metrics,
        data.methods,
        trivial=data.trivial,
        tasks=tasks,
        protocol_ids=data.protocol_ids,
        image_size=data.image_size,
        machine=data.machine,
        avatar_title=TITLES.get(layout, AVATAR_TITLE),
    )
