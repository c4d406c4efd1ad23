"""``headbench extremes`` and ``headbench reenact``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import tyro

from ...bench.contracts import Progress, no_progress
from ...bench.executors.command import ExecutionOptions
from ...bench.io.files import check_kind, output_inside
from ...bench.io.lock import locked
from ...bench.runner.config import RunOptions
from ...bench.specs import Findings

if TYPE_CHECKING:
    from ...bench.runner.steps import Job


@dataclass(frozen=True)
class ExtremesSettings(RunOptions, ExecutionOptions):
    """Render a run's avatars in views and expressions beyond those of training; 1 where a limit is broken."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write; default: `extremes` in the folder of the run."""

    methods: tuple[str, ...] = ()
    """Methods to test; default: all but the trivial baselines."""

    views: int = 16
    """Views of the turntable, in even steps."""

    beyond: float = 30.0
    """How far the turntable goes on beyond the outermost training cameras, degrees."""

    dimensions: int = 8
    """Principal components of the training expressions."""

    sigmas: tuple[float, ...] = (-3.0, -2.0, -1.0, 1.0, 2.0, 3.0)
    """How far along each component, in standard deviations."""

    def __post_init__(self) -> None:
        if self.views < 1 or self.dimensions < 1 or not self.sigmas:
            raise ValueError("views, dimensions and sigmas: at least one of each")
        if not 0.0 <= self.beyond < 180.0:
            raise ValueError(f"beyond is {self.beyond}; from 0 to less than 180 degrees")
        if len(set(self.sigmas)) != len(self.sigmas) or 0.0 in self.sigmas:
            raise ValueError("sigmas: each once, and without 0, which is always rendered")


@dataclass(frozen=True)
class ReenactSettings(RunOptions):
    """Drive a run's avatars with another subject's expressions (cross-reenactment); 1 where a limit is broken."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write; default: `cross_reenactment` in the folder of the run."""

    source: str | None = None
    """Capture (or folder of several) that drives; default: every other subject of the run."""

    methods: tuple[str, ...] = ()
    """Methods to drive; default: all but the trivial baselines."""

    camera: str | None = None
    """Camera of the target to render; default: the first held out, or else the first of training."""

    frames: int | None = None
    """Render at most so many timesteps of each source, evenly spaced; default: all."""

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise ValueError(f"frames is {self.frames}; at least 1")


Settings = TypeVar("Settings", ExtremesSettings, ReenactSettings)


def run_robustness_test(
    settings: Settings,
    default_folder: str,
    judge: Callable[[Sequence[Job], Settings, Path, Progress], list[dict[str, Any]]],
    write_sheet: Callable[[Path], Any],
    progress: Progress,
) -> Findings:
    """Judge the avatars of a run and write the contact sheet."""
    from ...bench.runner.run import trained
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
