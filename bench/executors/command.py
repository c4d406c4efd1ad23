"""``headbench status``, and the options of commands whose work an executor can do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from ..contracts import Progress
from ..runner.config import RunOptions
from ..specs import Findings


@dataclass(frozen=True)
class StatusSettings:
    """Shows the progress of a run, or afterwards, and changes nothing. Exit code 1: a cell failed."""

    run: tyro.conf.Positional[str]
    """Folder of the run."""


def status(settings: StatusSettings, progress: Progress) -> Findings:
    """Show which cells of a run are waiting, running, done or failed, and the time left."""
    from .status import run_status

    return run_status(Path(settings.run))


@dataclass(frozen=True)
class SpeedSettings(RunOptions):
    """Loads the stored avatars of a finished run and measures frames per second and times of a frame again, one avatar after
    another, without training. Only these rows are replaced; the former values stay in measure.json and run.log. Let nothing
    else run on the machine meanwhile. Exit code 1: an avatar could not be measured and keeps its former speed.
    """

    run: tyro.conf.Positional[str]
    """Folder of the run."""

    methods: tuple[str, ...] = ()
    """Only these methods; default: all of the run."""


def speed(settings: SpeedSettings, progress: Progress) -> Findings:
    """Measure the speed of a finished run's avatars again, without training, and update its tables and report."""
    from ..runner.speed import measure_speed_again

    return measure_speed_again(Path(settings.run), settings, settings.methods, progress)
