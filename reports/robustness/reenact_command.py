"""``headbench reenact``."""

from __future__ import annotations

from ...bench.contracts import Progress, no_progress
from ...bench.specs import Findings
from .command import try_run
from .reenactment import TASK, reenact
from .settings import ReenactSettings
from .sheets import write_reenact_sheet


def run(settings: ReenactSettings, progress: Progress = no_progress) -> Findings:
    """Drive the avatars of a run with other subjects; did not pass where a limit is broken.

    Raises `InputError` for a folder that is no finished run, where nobody else is there to drive, and for a source
    tracked with another head model.
    """
    return try_run(settings, TASK, reenact, write_reenact_sheet, progress)
