"""``headbench status``."""

from __future__ import annotations

from pathlib import Path

import tyro

from ..contracts import Progress
from ..specs import CommandResult, command


@command("status", group="compare")
def status(run: tyro.conf.Positional[str], progress: Progress) -> CommandResult:
    """Show which cells of a run are waiting, running, done or failed.

    Shows the progress of a run, or of a finished run. Exit code 1: a cell failed.

    Parameters
    ----------
    run : str
        Folder of the run.
    """
    from .status import run_status

    return run_status(Path(run))
