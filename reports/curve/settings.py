"""Settings of ``headbench report curve``."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from ...bench.experiments.curve_settings import Over


@dataclass(frozen=True)
class CurveReportSettings:
    """Runs of `headbench run curve` as one curve: of several subjects, or of several methods of a subject.

    Prints the means over subjects and the best method for each cost of a training, with 95 % intervals of the crossings of two methods."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders that `headbench run curve` wrote."""

    out: str
    """Folder to write: curve.csv and curve.png."""

    over: Over = "budget"
    """What the trainings differ in, as for `headbench run curve`."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")
