"""``headbench run curve``."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

from ...bench.contracts import Progress, no_progress
from ...bench.io.files import check_kind, output_inside
from ...bench.io.lock import locked
from ...bench.specs import Findings
from .settings import CurveSettings


def curve_run(settings: CurveSettings, progress: Progress = no_progress) -> Findings:
    """Plot quality against training time, cameras, timesteps or tracking error, measured on held-out training frames.

    Writes ``curve.csv`` and ``curve.png`` into the run folder of all trainings. Started again, it keeps what is done and
    refuses to leave out points that are there.
    Raises `InputError` for a folder that is no finished run, and for methods without a budget.
    """
    from ...bench.runner.store import RunFolder
    from .curve import curve

    run = RunFolder(Path(settings.run))
    run.read_manifest().check_done(run.manifest)  # before a folder is made in what is no run
    name = "curve" if settings.over == "budget" else f"curve-{settings.over.replace('_', '-')}"
    out = Path(settings.out) if settings.out else run.root / name
    check_kind(out, "a run")
    with nullcontext() if settings.out else output_inside(run.root), locked(out):
        return curve(settings, out)
