"""``headbench table``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..bench.contracts import Progress
from ..bench.errors import InputError
from ..bench.io.files import (
    check_writable,
    write_text,
)
from ..bench.specs import CommandResult, command


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
    from .table_report import tables_of, written

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
