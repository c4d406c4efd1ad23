"""``headbench verify`` and ``headbench evaluate``."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from ..contracts import Progress, TaskName, no_progress
from ..runner.config import RunOptions
from ..specs import Findings


@dataclass(frozen=True)
class VerifySettings(RunOptions):
    """Recompute a run's hashes and metrics from the files it left.

    Exit code 0: as recorded; 1: something differs; 2: wrong usage; 3: the run or its capture is missing or invalid.
    """

    run: tyro.conf.Positional[str]
    """Folder of a finished run, or of `headbench evaluate`."""


def verify(settings: VerifySettings, progress: Progress = no_progress) -> Findings:
    """Recompute a run's hashes and metrics from its frames: exit code 1 where anything differs, 3 where it is no run."""
    from .verify import verify_run

    return verify_run(settings, progress)


@dataclass(frozen=True)
class EvaluateSettings:
    """Score a folder of images named by key, so that a method needs no plug-in to be compared.

    An image is SEQUENCE_TIMESTEP_CAMERA.png (timestep of five digits), as `headbench run` names its renders: 8-bit RGB
    PNG of the ground truth's size, composited on the capture's background. It lies in FOLDER itself, in a folder named after
    the task, or in renders/TASK; with several subjects, in a folder named after the subject. A cell of a run
    (SUBJECT/METHOD/seed-N) has this layout, too.
    """

    folder: tyro.conf.Positional[str]
    """Folder with the images."""

    out: str
    """Folder to write: that of a run with one method, which every report, `table`, `compare`, `gate` and `verify` read."""

    clip: str | None = None
    """Capture to score against (or folder of several); default: that of the run named by --like."""

    label: str = "images"
    """What the method is called in tables; not the name of a registered method."""

    like: str | None = None
    """Run whose protocols to follow: capture, reader and its settings, tasks, frames, metrics are taken from it."""

    tasks: tuple[TaskName, ...] = ("novel_view", "self_reenactment")
    """What to score; with --like the run's."""

    metrics: tuple[str, ...] = ()
    """By which metrics of frames; default: those of `headbench run`; with --like the run's."""

    reader: str = ""
    """Which dataset reader opens the capture; default: the one that finds it; with --like the run's."""

    head: str | None = None
    """Head model for captures that bring none: FLAME pickle or npz."""

    trust: bool = False
    """With --like, import the modules that the run folder names for metrics and readers which are not registered; they
    can run any code."""

    frames_per_task: int | None = None
    """Score at most so many frames per subject and task, evenly spaced, as the run compared with did."""

    def __post_init__(self) -> None:
        """Refuse what leaves open what to score against."""
        if self.clip is None and self.like is None:
            raise ValueError("say what to score against: --clip CAPTURE, or --like RUN")


def evaluate(settings: EvaluateSettings, progress: Progress = no_progress) -> Findings:
    """Score a folder of images named by key: a method is compared without a plug-in."""
    from .evaluate import evaluate_folder

    return evaluate_folder(settings, progress)
