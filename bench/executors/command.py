"""``headbench status``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from ..contracts import Progress
from ..specs import CommandResult


@dataclass(frozen=True)
class StatusSettings:
    """Shows the progress of a run, or of a finished run. Exit code 1: a cell failed."""

    run: tyro.conf.Positional[str]
    """Folder of the run."""


def status(settings: StatusSettings, progress: Progress) -> CommandResult:
    """Show which cells of a run are waiting, running, done or failed, and the time left."""
    from .status import run_status

    return run_status(Path(settings.run))
