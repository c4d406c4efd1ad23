"""``headbench synth``.

Requirements of the synthetic capture on the machine, for `DatasetSpec.needs`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ...bench.contracts import Progress
from ...bench.engine.config import (
    parse_size,
)
from ...bench.executors.settings import ExecutionOptions, check_executor
from ...bench.io.files import (
    check_kind,
    check_output_folder,
)
from ...bench.io.lock import locked
from ...bench.specs import CommandResult, Need, command


def needs(config: Any, device: str) -> Iterator[Need]:
    """The kernel that renders the pictures."""
    from .panels import KERNEL

    yield KERNEL.need()


@dataclass(frozen=True)
class SynthSettings(ExecutionOptions):
    """Ray-traced heads of people of all ages, lit by eight large panels, on NeRSemble's camera rig, with NeRSemble's names of
    sequences. Skin wrinkles and blushes with expressions, with hysteresis and delay. The same settings give the same bytes on
    every processor; frames that exist are kept. Needs the compiled kernel.
    """

    out: str
    """Folder to write."""
    subjects: int = 1
    """Number of heads; each differs in shape, skin, hair."""
    cameras: int = 16
    """2 to 16 views; the frontal one is always included and held out as the novel view."""
    timesteps: int = 60
    """Frames per camera, distributed over the sequences; FREE is held out for self-reenactment."""
    size: str = "275x401"
    """Width x height of the images in pixels, for example 550x802 (NeRSemble at a quarter)."""
    head: str = "procedural"
    """`procedural`, or the path of a head model (the folder `FaceXModel` of ICT-FaceKit)."""
    seed: int = 0
    """Seed of subjects and performances."""
    tracking_noise: float = 0.0
    """Noise on the tracked parameters, as a fraction of their standard deviation."""
    performance: Literal["natural", "full", "parts", "expressions", "still"] = "natural"
    """`natural` has the speeds, blinks, gaze and correlations of tracked recordings, at every n-th frame of a video; from 59
    timesteps it plays every sequence and holds out speech and three parts of FREE, each scored as a sequence: seen, recombined
    and beyond the range of training. `full` and `parts` are the smooth performances of earlier editions, without and with these
    parts. `expressions` is `full` without motion of jaw and tongue, and `still` moves only head, neck and eyes."""
    dynamics: float = 1.0
    """Scale of wrinkles and blush, 0 to 3."""
    tracking_error: float = 0.0
    """Level of simulated tracking errors: shrunk and mixed expressions, drift; 1 is 0.5 to 1 mm on the face, 2 to 3 mm
    on lips and lids. 0 to 4."""
    tracker: Literal["video", "per-frame"] = "video"
    """Tracker whose errors are simulated. A video tracker has a constant error for each sequence, slow
    drift, jitter, and 1.2 mm on lips and lids; the error of a per-frame tracker drifts from each timestep
    to the next."""
    hair_lag: float = 0.0
    """Lag of hair and of the skin of the neck behind the head, which the tracked mesh does not have; at 1 hair swings like a
    rod of its length. 0 to 4."""
    camera_colour: float = 0.0
    """Differences between cameras in exposure (5 % at 1), white balance (2 %) and gamma (3 %). 0 to 4."""
    motion_blur: float = 0.0
    """Exposure time in units of NeRSemble's 3 ms. Frames with motion take several times as long to render. 0 to 4."""
    mask_error: float = 0.0
    """Errors of masks at hair: single hairs are missing, and outlines are displaced by up to 4 mm at 1. Images are composited
    with these masks. 0 to 4."""
    correctives: float = 0.0
    """Shapes of each subject that the head model lacks, driven by pairs of controls; each is 0.75 mm on the face at 1. The
    tracked mesh does not have them. 0 to 4."""


@command("synth", group="data")
def synth(settings: SynthSettings, progress: Progress) -> CommandResult:
    """Render a synthetic multi-view capture in the GaussianAvatars/VHAP layout."""
    out, execution = Path(settings.out), settings.execution
    check_executor(execution, "cpu")
    check_kind(out, "a synthetic capture", "captures")
    check_output_folder(out)
    with locked(out, beside=True):  # a capture is made in an empty folder
        size = parse_size(settings.size)
        from .capture import synthesize  # slow to import

        values = {**settings.others, "out": out, "size": size}
        synthesize(**values, execution=execution, progress=progress)
    return CommandResult(settings.out, {"out": out})
