"""``headbench report``."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from ...bench.contracts import Progress, no_progress
from ...bench.runner.config import RunOptions
from ...bench.specs import Findings

MAX_MB = 20.0


@dataclass(frozen=True)
class PageSettings(RunOptions):
    """Write one HTML file that shows finished runs: tables, frames of all methods side by side, curves, the record.

    It needs no network and no other file. Pictures are chosen to fit in --max-mb: the worst frames of each method and task
    always, the others evenly over time.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs on the same frames, as for `headbench table`."""

    out: str = "report.html"
    """File to write."""

    max_mb: float = MAX_MB
    """Megabytes (10^6 bytes) that the file may have."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")
        if not 0.1 <= self.max_mb <= 1000:
            raise ValueError(f"max-mb is {self.max_mb}; from 0.1 to 1000")


def report(settings: PageSettings, progress: Progress = no_progress) -> Findings:
    """Write one HTML file that shows finished runs and opens without a network.

    Raises `InputError` for folders that are no finished runs or do not compare, a file that cannot be written, and
    bytes that do not suffice.
    """
    from .report import write_report

    return write_report(settings, progress)
