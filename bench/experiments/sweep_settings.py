"""Settings of ``headbench run sweep``."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from ..engine.config import RunOptions
from ..executors.options import ExecutionOptions


@dataclass(frozen=True)
class SweepSettings(RunOptions, ExecutionOptions):
    """Quality against size and frame time of variants derived from a run's avatars without training."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write, a run folder itself; default: `sweep` in the folder of the run. The same sweep in it is continued."""

    methods: tuple[str, ...] = ()
    """Methods to derive from; default: all that provide variants."""

    variants: tuple[str, ...] = ()
    """Variants to derive, by name; default: all. The trained avatar itself is always measured."""

    frames: int | None = None
    """Maximum number of scored frames per subject and task, evenly spaced; default: that of the run."""

    task: str = "novel_view"
    """Task whose frames give the quality in the plot."""

    metric: str = ""
    """Metric of quality in the plot; default: the first of frames that the run has."""

    time: str = ""
    """Metric of frame time in the plot, in ms: latency_p50 (default), processor_time on a machine with other work."""

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise ValueError(f"frames is {self.frames}; at least 1")
