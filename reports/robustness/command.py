"""``headbench run extremes`` and ``headbench run reenact``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ...bench.contracts import Progress, no_progress
from ...bench.io.files import check_kind, output_inside
from ...bench.io.lock import locked
from ...bench.specs import Findings
from .settings import ExtremesSettings, ReenactSettings

if TYPE_CHECKING:
    from ...bench.runner.steps import Job


Settings = TypeVar("Settings", ExtremesSettings, ReenactSettings)


def run_robustness_test(
    settings: Settings,
    default_folder: str,
    judge: Callable[[Sequence[Job], Settings, Path, Progress], list[dict[str, Any]]],
    write_sheet: Callable[[Path], Any],
    progress: Progress,
) -> Findings:
    """Judge the avatars of a run and write the contact sheet."""
    from ...bench.runner.jobs import trained
    from ...bench.runner.store import RunFolder
    from .stability import SHEET_FILE, table

    folder = Path(settings.run)
    out = Path(settings.out) if settings.out else folder / default_folder
    RunFolder(folder).read_manifest()  # before a folder is made in what is no run
    check_kind(out)
    with nullcontext() if settings.out else output_inside(folder), locked(out):
        _, jobs = trained(folder, settings.methods, settings, out)
        summaries = judge(jobs, settings, out, progress)
        rendered = any("missing" not in summary for summary in summaries)
        if rendered:
            write_sheet(out)
    text = f"{table(summaries)}\n{out / SHEET_FILE}" if rendered else table(summaries)
    passed = all(summary["frames_broken"] == 0 for summary in summaries)
    return Findings(text, {"out": out, "avatars": summaries}, passed)


def extremes_run(settings: ExtremesSettings, progress: Progress = no_progress) -> Findings:
    """Render a run's avatars in views and expressions beyond those of training; check stability limits.

    Does not pass where a limit is broken. Raises `InputError` for a folder that is no finished run, and for a capture
    that is not the run's.
    """
    from ...bench.executors.settings import check_executor
    from .extremes import TASK as EXTREMES
    from .extremes import judge_extremes
    from .sheets import write_extremes_sheet

    check_executor(settings.execution, "cpu")
    return run_robustness_test(settings, EXTREMES, judge_extremes, write_extremes_sheet, progress)


def reenact_run(settings: ReenactSettings, progress: Progress = no_progress) -> Findings:
    """Drive a run's avatars with another subject's expressions; check stability limits.

    Does not pass where a limit is broken. Raises `InputError` for a folder that is no finished run, where nobody else
    is there to drive, and for a source tracked with another head model.
    """
    from .reenactment import TASK as REENACTMENT
    from .reenactment import judge_reenactment
    from .sheets import write_reenact_sheet

    return run_robustness_test(settings, REENACTMENT, judge_reenactment, write_reenact_sheet, progress)
