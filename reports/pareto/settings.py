"""Settings of ``headbench report pareto``."""

from __future__ import annotations

from dataclasses import dataclass

import tyro


@dataclass(frozen=True)
class ParetoSettings:
    """Quality against size and frame time, over finished runs of the same frames; CSV, and a plot with the front."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs: every method in each is a point, such as the settings of a sweep. Runs of different subjects
    with the same methods and settings are joined; several trainings of a subject have a curve of rates each."""

    out: str
    """Folder to write: points.csv and pareto.png; with coded avatars also rates.csv and rate_distortion.png."""

    task: str = "novel_view"
    """Task whose frames give the quality."""

    metric: str = ""
    """Metric of quality; default: the first of frames that the runs have."""

    time: str = ""
    """Metric of frame time, in ms: latency_p50 (default, or 1 / frames per second), processor_time, ..."""

    reference: str = ""
    """Method that BD-rates compare with, if the runs have coded avatars at several steps; default: the first."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")
