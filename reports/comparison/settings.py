"""Settings of ``headbench compare``. Light to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class CompareSettings:
    """Paired differences between methods of finished runs: size, interval, exact test, Holm's correction."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs on the same frames. Further seeds of a method join it; another setting is another
    method."""

    against: Annotated[str | None, tyro.conf.arg(metavar="METHOD")] = None
    """Compare every method with this one alone, instead of all pairs: fewer comparisons, so fewer subjects needed."""

    metrics: tuple[str, ...] = ()
    """Metrics to compare; default: those of the comparison table."""

    floors: bool = False
    """Compare the floors (mean image, nearest camera), too."""

    level: float = 0.05
    """Level of the tests; intervals have a confidence of one minus it."""

    format: Literal["text", "csv"] = "text"
    """How to print; --json gives everything, each subject's difference included."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")
        if not 0 < self.level < 1:
            raise ValueError(f"level is {self.level}; a number between 0 and 1")
