"""Settings of ``headbench run extremes`` and ``headbench run reenact``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import tyro

from ..engine.config import RunOptions
from ..executors.options import ExecutionOptions


@dataclass(frozen=True)
class ExtremesSettings(RunOptions, ExecutionOptions):
    """Render a run's avatars in new views and in random poses of expression and jaw; exit code 1 if a limit is exceeded.
    Synthetic captures have a path-traced ground truth for every pose and view."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write; default: `extremes` in the folder of the run."""

    methods: tuple[str, ...] = ()
    """Methods to test; default: all but the trivial baselines."""

    views: int = 16
    """Views of the turntable, in even steps."""

    beyond: float = 30.0
    """Angle of the turntable beyond the outermost training cameras, degrees."""

    dimensions: int = 8
    """Principal components of expression and jaw in training."""

    samples: int = 24
    """Number of random poses along all components, each rendered in two views."""

    sigmas: float = 3.0
    """Largest distance along a component, in standard deviations; never beyond the range of training."""

    path: int = 12
    """Frames of a sequence through two of the poses, for flicker; 0: none."""

    def __post_init__(self) -> None:
        for name, least in (("views", 1), ("dimensions", 1), ("samples", 1), ("path", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; at least {least}")
        if not 0.0 <= self.beyond < 180.0:
            raise ValueError(f"beyond is {self.beyond}; from 0 to less than 180 degrees")
        if not 0.0 < self.sigmas <= 10.0:
            raise ValueError(f"sigmas is {self.sigmas}; above 0, at most 10")

    @property
    def parameters(self) -> dict[str, Any]:
        """Of the registered change "extremes"."""
        names = ("views", "beyond", "dimensions", "samples", "sigmas", "path")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class ReenactSettings(RunOptions, ExecutionOptions):
    """Drive a run's avatars with another subject's expressions (cross-reenactment); exit code 1 if a limit
    is exceeded."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write; default: `cross_reenactment` in the folder of the run."""

    source: str | None = None
    """Driving capture (or folder of several); default: every other subject of the run."""

    methods: tuple[str, ...] = ()
    """Methods to drive; default: all but the trivial baselines."""

    camera: str | None = None
    """Camera of the target to render; default: the first held out, or else the first of training."""

    frames: int | None = None
    """Maximum number of rendered timesteps of each source, evenly spaced; default: all."""

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise ValueError(f"frames is {self.frames}; at least 1")

    @property
    def parameters(self) -> dict[str, Any]:
        """Of the registered change "reenact"."""
        return {"source": self.source, "camera": self.camera, "frames": self.frames}
