"""``headbench status``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from ..contracts import Progress
from ..specs import Findings


@dataclass(frozen=True)
class StatusSettings:
    """Looks at a run folder while its cells are worked on, or afterwards, and changes nothing. Exit code 1: a cell failed."""

    run: tyro.conf.Positional[str]
    """Folder of the run."""


def status(settings: StatusSettings, progress: Progress) -> Findings:
    """Show which cells of a run wait, are worked on, are done or have failed, and the time left."""
    from .status import run_status

    return run_status(Path(settings.run))
