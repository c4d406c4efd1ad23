"""Settings of the commands verify, evaluate and frames."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from ..contracts import TaskName
from ..engine.config import RunOptions
from ..errors import InputError
from ..executors.options import ExecutionOptions
from ..options import DependentOptions


@dataclass(frozen=True)
class VerifySettings(RunOptions):
    """Score the stored frames of runs again and compare the values with those of the runs.

    Captures, protocols, frames and avatars are compared with the run's record, too. The last line of a run names what was not
    verified. Exit code 0: everything that was verified is as recorded; 1: something differs; 2: wrong usage; 3: a run or its
    capture is missing or invalid.
    """

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs, or of `headbench evaluate`."""

    render: bool = False
    """Also render the stored avatars again and compare the frames, which may differ by one level of 8 bits."""

    def __post_init__(self) -> None:
        """Refuse to verify nothing."""
        if not self.runs:
            raise InputError("command line", "RUNS", "a run", "none")


@dataclass(frozen=True)
class EvaluateSettings(ExecutionOptions):
    """Score a folder of images, made without a plug-in, or a stored avatar.

    An image is SEQUENCE_TIMESTEP_CAMERA.png (timestep of five digits), as `headbench run` names its renders: 8-bit RGB PNG of
    the ground truth's size, composited on the capture's background. It lies in FOLDER itself, in a folder named after the task,
    or in renders/TASK; with several subjects, in a folder named after the subject. A cell of a run (SUBJECT/METHOD/seed-N) also
    has this layout. Give other names with --names.
    """

    folder: tyro.conf.Positional[str]
    """Folder with the images, or with --avatar that of an avatar as `headbench render` takes it."""

    out: str
    """Folder to write: a run with one method, which `table`, `compare`, `verify` and every report can read."""

    clip: str | None = None
    """Capture to score against (or folder of several); default: that of the run named by --like."""

    label: str = ""
    """Name of the method in tables; not the name of a registered method. Default: images, with --avatar the method that
    avatar.json names."""

    avatar: bool = False
    """FOLDER holds an avatar: it is rendered, and its storage and speed are measured, too."""

    method: str = ""
    """With --avatar: its method as package.module:SPEC, where that is not registered."""

    device: str = "cpu"
    """Device of metrics that can use a GPU, and of rendering with --avatar."""

    names: str = ""
    """How the images are named, if not by key: a method whose own program numbers its renders, such as an adapter to an
    official repository, or a file MAP.csv with the columns file, sequence, timestep, camera (and subject with several)."""

    any_background: bool = False
    """Score images as they are even where their background is not the capture's, which is refused otherwise."""

    like: str | None = None
    """Run whose protocols to follow: capture, reader and its settings, tasks, frames, metrics are taken from it."""

    tasks: tuple[TaskName, ...] = ("novel_view", "self_reenactment")
    """Tasks to score. Not with --like, whose run decides it."""

    metrics: tuple[str, ...] = ()
    """Metrics of frames to compute; default: those of `headbench run`. Not with --like."""

    protocol: tuple[str, ...] = ()
    """Published protocols, as for `headbench run`. Not with --like."""

    reader: str = ""
    """Which dataset reader opens the capture; default: the one that finds it. Not with --like."""

    head: str | None = None
    """Head model of captures that do not contain one: FLAME pickle or npz."""

    trust: bool = False
    """With --like, import the modules that the run folder names for metrics and readers which are not registered; they
    can run any code."""

    frames_per_task: int | None = None
    """Largest number of frames scored per subject and task, evenly spaced; default: all. Not with --like."""

    dependent = (
        DependentOptions(("tasks", "metrics", "protocol", "reader", "frames_per_task"), "like", False),
        DependentOptions(("trust",), "like"),
        DependentOptions(("method",), "avatar"),
        DependentOptions(("names", "any_background"), "avatar", False),
    )

    def __post_init__(self) -> None:
        """Refuse settings without a reference for the evaluation."""
        if self.clip is None and self.like is None:
            raise ValueError("state the reference: --clip CAPTURE or --like RUN")


@dataclass(frozen=True)
class FramesSettings(RunOptions):
    """List the frames that `headbench evaluate` scores, for renders that are made outside of headbench.

    Writes OUT/frames.csv, one row for each frame: task, key (subject, sequence, timestep, camera), the file name that
    `headbench evaluate` expects in a folder of images, size, background, intrinsics in pixels (the centre of the top left pixel
    is at 0.5, 0.5), the first three rows of the 4 x 4 world-to-camera matrix (OpenCV axes, metres), and the file with the
    tracking parameters of the timestep, where the capture has one. OUT/MAP.csv has the same frames in the format of `headbench
    evaluate --names`: replace the names in its column file by those of your renders.
    """

    source: tyro.conf.Positional[str]
    """Folder of a run, whose protocols are followed, or a capture (or folder of several)."""

    out: str
    """Folder to write."""

    tasks: tuple[TaskName, ...] = ()
    """Tasks to list for a capture; default: those of `headbench run`."""

    frames_per_task: int | None = None
    """For a capture: maximum number of frames per subject and task, evenly spaced, as in `headbench run`."""

    reader: str = ""
    """Which dataset reader opens the capture; default: the one that finds it."""
