"""``headbench extremes``."""

from __future__ import annotations

from ...bench.contracts import Progress, no_progress
from ...bench.specs import Findings
from .command import try_run
from .extremes import TASK, try_extremes
from .settings import ExtremesSettings
from .sheets import write_extremes_sheet


def run(settings: ExtremesSettings, progress: Progress = no_progress) -> Findings:
    """Try the avatars of a run; did not pass where a limit is broken.

    Raises `InputError` for a folder that is no finished run, and for a capture that is not the run's.
    """
    return try_run(settings, TASK, try_extremes, write_extremes_sheet, progress)
