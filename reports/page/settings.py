"""Settings of the report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from ...bench.engine.config import RunOptions

MAX_MB, MAX_SPLIT_MB = 10.0, 500.0


@dataclass(frozen=True)
class PageSettings(RunOptions):
    """Write finished runs to one HTML file: what it shows in words, frames of all methods side by side, tables, curves, provenance.

    It needs no network and no other file. Pictures are chosen to fit in --max-mb: the worst frames of each
    method and task always, the others evenly over time. With --split it is a folder whose index.html loads
    pictures when they are viewed, for large runs.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs on the same frames, as for `headbench table`."""

    out: str | None = None
    """File to write, with --split a folder that is new or holds an earlier report. By default report.html or report."""

    split: bool = False
    """Whether pictures are in separate files, in a folder with the page."""

    max_mb: float | None = None
    """Maximum size in megabytes (10^6 bytes). By default 10, with --split 500."""

    papers: Annotated[tuple[str, ...], tyro.conf.arg(name="as")] = ()
    """Papers in the form of whose tables the runs are shown, too, with the rows that they printed: `headbench list papers`."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")
        if self.max_mb is not None and not 0.1 <= self.max_mb <= (most := 4000 if self.split else 1000):
            raise ValueError(f"max-mb is {self.max_mb}; from 0.1 to {most}")
