"""``headbench extremes``."""

from __future__ import annotations

from pathlib import Path

from ...bench.contracts import Findings, Progress, no_progress
from ...bench.robustness.avatars import trained
from ...bench.robustness.extremes import try_extremes
from ...bench.robustness.settings import ExtremesSettings
from ...bench.robustness.trial import SHEET_FILE, table
from ...bench.store import RunFolder
from .extremes_sheet import write_extremes_sheet


def run(settings: ExtremesSettings, progress: Progress = no_progress) -> Findings:
    """Try the avatars of a run; did not pass where a limit is broken.

    Raises `InputError` for a folder that is no finished run, and for a capture that is not the run's.
    """
    folder = Path(settings.run)
    out = Path(settings.out) if settings.out else folder / "extremes"
    jobs = trained(folder, settings.methods, settings.data)
    RunFolder(out).prepare()
    summaries = try_extremes(jobs, settings, out, progress)
    write_extremes_sheet(out)
    text = f"{table(summaries)}\n{out / SHEET_FILE}"
    passed = all(s["frames_broken"] == 0 for s in summaries)
    return Findings(text, {"out": out, "avatars": summaries}, passed)
