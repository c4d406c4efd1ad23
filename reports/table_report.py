"""The comparison table of a run folder, as files or as text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..bench.errors import InputError
from ..bench.files import write_text
from .csv_table import to_csv
from .latex import to_latex
from .markdown import to_markdown
from .run_data import RunData
from .tables import Table, build_table

WRITERS: dict[str, tuple[str, Callable[[Table], str]]] = {
    "md": ("comparison.md", to_markdown),
    "csv": ("comparison.csv", to_csv),
    "latex": ("comparison.tex", to_latex),
}


def write_tables(run_folder: Path) -> list[Path]:
    """Write the table of a run in every format into its folder of tables; return the files."""
    data = RunData.read(run_folder)
    table = table_of(data)
    files = []
    for name, write in WRITERS.values():
        path = data.folder.tables / name
        write_text(path, write(table))
        files.append(path)
    return files


def table_text(run_folder: Path, format: str = "md") -> str:
    """Return the table of a run as text: "md", "csv" or "latex"."""
    if format not in WRITERS:
        raise InputError("table", "format", f"one of {', '.join(WRITERS)}", repr(format))
    _, write = WRITERS[format]
    return write(table_of(RunData.read(run_folder)))


def table_of(data: RunData) -> Table:
    """Build the table of a run that was read."""
    return build_table(
        data.rows,
        data.metrics,
        data.methods,
        trivial=data.trivial,
        tasks=data.tasks,
        protocol_ids=data.protocol_ids,
        image_size=data.image_size,
        machine=data.machine,
    )
