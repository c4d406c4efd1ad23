"""What ``headbench extremes`` and ``headbench reenact`` have in common: avatars of a run, a folder, a sheet, limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, TypeVar

from ...bench.contracts import Progress
from ...bench.io.files import output_inside
from ...bench.io.lock import locked
from ...bench.runner.avatars import trained
from ...bench.runner.stages import Job
from ...bench.runner.store import RunFolder
from ...bench.specs import Findings
from .settings import ExtremesSettings, ReenactSettings
from .stability import SHEET_FILE, table

Settings = TypeVar("Settings", ExtremesSettings, ReenactSettings)


def try_run(
    settings: Settings,
    default_folder: str,
    attempt: Callable[[Sequence[Job], Settings, Path, Progress], list[dict[str, Any]]],
    write_sheet: Callable[[Path], Any],
    progress: Progress,
) -> Findings:
    """Try the avatars of a run, write the contact sheet; did not pass where a limit is broken."""
    folder = Path(settings.run)
    out = Path(settings.out) if settings.out else folder / default_folder
    RunFolder(folder).read_manifest()  # before a folder is made in what is no run
    with nullcontext() if settings.out else output_inside(folder), locked(out):
        _, jobs = trained(folder, settings.methods, settings, out)
        summaries = attempt(jobs, settings, out, progress)
        write_sheet(out)
    text = f"{table(summaries)}\n{out / SHEET_FILE}"
    passed = all(summary["frames_broken"] == 0 for summary in summaries)
    return Findings(text, {"out": out, "avatars": summaries}, passed)
