"""``headbench status`` and ``headbench run speed``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from ..contracts import Progress
from ..engine.config import RunOptions
from ..engine.disk import Deletable
from ..specs import CommandResult


@dataclass(frozen=True)
class StatusSettings:
    """Shows the progress of a run, or of a finished run, and its disk usage. Exit code 1: a cell failed."""

    run: tyro.conf.Positional[str]
    """Folder of the run."""

    clean: tuple[Deletable, ...] = ()
    """Delete files that can be recreated: renders (the next start renders them again), checkpoints of
    trainings that did not end, damaged avatars that were set aside, logs of processes and jobs."""


def status(settings: StatusSettings, progress: Progress) -> CommandResult:
    """Show which cells of a run are waiting, running, done or failed, and the time left."""
    from ..engine.disk import clean, shown, usage
    from .status import run_status

    run = Path(settings.run)
    freed = clean(run, settings.clean) if settings.clean else 0
    found = run_status(run)
    sizes = usage(run)
    parts = ", ".join(f"{kind} {shown(size)}" for kind, size in sizes.items() if size)
    text = f"{found.text}\ndisk: {shown(sum(sizes.values()))}: {parts}"
    if settings.clean:
        text += f"\ndeleted: {shown(freed)} of {', '.join(settings.clean)}"
        text += "; the next start of the run renders again" if "renders" in settings.clean else ""
    return found._replace(text=text, data={**found.data, "disk": sizes, "deleted": freed})


@dataclass(frozen=True)
class SpeedSettings(RunOptions):
    """Loads the stored avatars of a finished run and measures frames per second and times of a frame again,
    one avatar after another, without training. Only these rows are replaced; the former values stay in
    measure.json and run.log. No other programs should run on the machine. Exit code 1: an avatar could not be
    measured and keeps its former speed.
    """

    run: tyro.conf.Positional[str]
    """Folder of the run."""

    methods: tuple[str, ...] = ()
    """Only these methods; default: all of the run."""


def speed(settings: SpeedSettings, progress: Progress) -> CommandResult:
    """Measure the speed of a finished run's avatars again, without training, and update its tables and report."""
    from ..engine.speed import measure_speed_again

    return measure_speed_again(Path(settings.run), settings, settings.methods, progress)
