"""Settings of ``headbench run extremes`` and ``headbench run reenact``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import tyro

from ..engine.config import RunOptions
from ..executors.options import ExecutionOptions


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

    @property
    def parameters(self) -> dict[str, Any]:
        """Of the registered change "extremes"."""
        chosen = {"views": self.views, "beyond": self.beyond, "dimensions": self.dimensions}
        return {**chosen, "sigmas": list(self.sigmas)}


@dataclass(frozen=True)
class ReenactSettings(RunOptions, ExecutionOptions):
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
    """Maximum number of rendered timesteps of each source, evenly spaced; default: all."""

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise ValueError(f"frames is {self.frames}; at least 1")

    @property
    def parameters(self) -> dict[str, Any]:
        """Of the registered change "reenact"."""
        return {"source": self.source, "camera": self.camera, "frames": self.frames}
