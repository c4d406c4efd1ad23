"""``headbench reenact``."""

from __future__ import annotations

from pathlib import Path

from ...bench.contracts import Findings, Progress, no_progress
from ...bench.robustness.avatars import trained
from ...bench.robustness.reenactment import TASK, reenact
from ...bench.robustness.settings import ReenactSettings
from ...bench.robustness.trial import SHEET_FILE, table
from ...bench.store import RunFolder
from .reenact_sheet import write_reenact_sheet


def run(settings: ReenactSettings, progress: Progress = no_progress) -> Findings:
    """Drive the avatars of a run with other subjects; did not pass where a limit is broken.

    Raises `InputError` for a folder that is no finished run, where nobody else is there to drive, and for a source
    tracked with another head model.
    """
    folder = Path(settings.run)
    out = Path(settings.out) if settings.out else folder / TASK
    jobs = trained(folder, settings.methods, settings.data)
    RunFolder(out).prepare()
    summaries = reenact(jobs, settings, out, progress)
    write_reenact_sheet(out)
    text = f"{table(summaries)}\n{out / SHEET_FILE}"
    passed = all(s["frames_broken"] == 0 for s in summaries)
    return Findings(text, {"out": out, "avatars": summaries}, passed)
