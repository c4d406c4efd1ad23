"""Settings of the report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from ...bench.engine.config import RunOptions

MAX_MB, MAX_SPLIT_MB = 10.0, 500.0


@dataclass(frozen=True)
class PageSettings(RunOptions):
    """Write finished runs to one HTML file: the result in words, frames of all methods side by side, tables, curves, record of
    the run.

    It needs no network and no other file. Images are chosen to fit in --max-mb: always the worst frames of each method and
    task, the others evenly over time. With --split the output is a folder, for large runs, whose index.html loads images when
    they are viewed.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs on the same frames, as for `headbench table`."""

    out: str | None = None
    """File to write, with --split a folder that is new or holds an earlier report. By default report.html or report."""

    split: bool = False
    """Write images to separate files, in a folder with the page."""

    max_mb: float | None = None
    """Maximum size in megabytes (10^6 bytes). By default 10, with --split 500."""

    papers: Annotated[tuple[str, ...], tyro.conf.arg(name="as")] = ()
    """Papers (`headbench list papers`) in whose table layout the runs are also shown, with the rows of the paper."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")
        if self.max_mb is not None and not 0.1 <= self.max_mb <= (most := 4000 if self.split else 1000):
            raise ValueError(f"max-mb is {self.max_mb}; from 0.1 to {most}")
