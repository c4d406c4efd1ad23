"""Settings of ``headbench run curve``."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Literal, TypeAlias

import tyro

from ..condition import part_of_text
from ..engine.config import RunOptions
from ..executors.options import ExecutionOptions
from ..options import DependentOptions

MOST_TRACKING_ERROR = 4.0
"""Maximum level of `headbench synth`."""
FRACTIONS = ("1/16", "1/8", "1/4", "1/2", "1")
LEVELS = (0.0, 1.0, 2.0)
SECONDS, PICTURES = (5.0, 30.0, 120.0), (1, 4, 16)
Over: TypeAlias = Literal["budget", "seconds", "cameras", "timesteps", "pictures", "tracking_error"]


@dataclass(frozen=True)
class CurveSettings(RunOptions, ExecutionOptions):
    """Quality against training time, cameras, timesteps, images or tracking error. Each method is trained with parts of them.

    Each part, number or level is a separate training. Quality is measured on training frames that are held out of every
    training, the same for all parts, never on test frames."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write, a run folder itself; default: `curve` in the folder of the run, or `curve-cameras` and so on."""

    methods: tuple[str, ...] = ()
    """Methods to train; default: all but the trivial baselines."""

    over: Over = "budget"
    """What is varied: fractions of budget, cameras or timesteps; numbers of seconds of training or of images (pictures); or the
    tracking error of a synthetic capture, whose images stay the same."""

    fractions: tuple[str, ...] = ()
    """Parts of the method's budget, or of the training cameras or timesteps, above 0 and at most 1; default: 1/16 1/8 1/4 1/2
    1. Not with `--over tracking_error`."""

    seconds: tuple[float, ...] = ()
    """Training times for `--over seconds`; default: 5 30 120. Trainings with a time limit are not bitwise reproducible. Not
    with another `--over`."""

    pictures: tuple[int, ...] = ()
    """Numbers of training frames for `--over pictures`; default: 1 4 16. Not with another `--over`."""

    levels: tuple[float, ...] = ()
    """Levels for `--over tracking_error`, as for `headbench synth`; default: 0 1 2. Not with another `--over`."""

    camera: str = ""
    """Training camera to hold out; default: the one nearest to the mean position of the training cameras."""

    every: int = 8
    """Hold out one of this number of consecutive training timesteps."""

    frames: int = 100
    """Maximum number of scored frames of each subject, for the held-out camera and timesteps separately."""

    dependent = (
        DependentOptions(("levels",), "over", ("tracking_error",)),
        DependentOptions(("seconds",), "over", ("seconds",)),
        DependentOptions(("pictures",), "over", ("pictures",)),
        DependentOptions(("fractions",), "over", ("budget", "cameras", "timesteps")),
    )

    def __post_init__(self) -> None:
        if len(set(self.parts)) != len(self.parts):
            raise ValueError(f"fractions: each once; found {' '.join(self.fractions)}")
        if len(set(self.levels)) != len(self.levels):
            raise ValueError(f"levels: each once; found {' '.join(map(str, self.levels))}")
        for name in ("seconds", "pictures"):
            values = getattr(self, name)
            if len(set(values)) != len(values) or not all(value > 0 for value in values):
                raise ValueError(f"{name}: numbers above 0, each once; found {' '.join(map(str, values))}")
        if not all(1e-3 <= value < 1e6 and float(f"{value:g}") == value for value in self.seconds):
            expected = "from 0.001 to below 1,000,000, with at most six digits"
            raise ValueError(f"seconds: {expected}; found {' '.join(map(str, self.seconds))}")
        if not all(0 <= level <= MOST_TRACKING_ERROR for level in self.levels):
            expected = f"from 0 to {MOST_TRACKING_ERROR:g}"
            raise ValueError(f"levels: {expected}; found {' '.join(map(str, self.levels))}")
        if self.every < 2:
            raise ValueError(f"every is {self.every}; at least 2")
        if self.frames < 1:
            raise ValueError(f"frames is {self.frames}; at least 1")

    @property
    def parts(self) -> tuple[Fraction, ...]:
        """The fractions as numbers, rising. Raises `ValueError` unless they are numbers in (0, 1]."""
        return tuple(sorted(map(_part, self.fractions or FRACTIONS)))

    @property
    def tracking_errors(self) -> tuple[float, ...]:
        """The levels, rising."""
        return tuple(sorted(self.levels or LEVELS))


def _part(text: str) -> Fraction:
    return part_of_text(text, "fractions")
