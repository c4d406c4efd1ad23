"""``headbench sweep``: variants of a run's avatars, their table and their plot."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

from ...bench.contracts import Progress, no_progress
from ...bench.io.files import output_inside
from ...bench.io.lock import locked
from ...bench.runner.store import RunFolder
from ...bench.specs import Findings
from .command import run as compare
from .settings import ParetoSettings, SweepSettings
from .sweep import sweep


def run(settings: SweepSettings, progress: Progress = no_progress) -> Findings:
    """Derive, measure, and write ``points.csv`` and ``pareto.png`` as `headbench pareto` does.

    Raises `InputError` for a folder that is no finished run, and for methods and variants that there are not.
    """
    out = Path(settings.out) if settings.out else Path(settings.run) / "sweep"
    RunFolder(Path(settings.run)).read_manifest()  # before a folder is made in what is no run
    with nullcontext() if settings.out else output_inside(Path(settings.run)), locked(out):
        sweep(settings, out, progress)
        what = settings.task, settings.metric, settings.time
        return compare(ParetoSettings((str(out),), str(out), *what), progress)
