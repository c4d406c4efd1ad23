"""``headbench suite``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ...bench.contracts import Progress, no_progress
from ...bench.runner.config import parse_size
from ...bench.specs import Findings, writes

SEED = 26_000
"""Of the suite's captures. Settings of methods are chosen on captures of seeds below 10,000 (`README.md`)."""


@dataclass(frozen=True)
class SuiteSettings:
    """The whole benchmark: makes the suite's synthetic subjects, trains and measures methods on all, writes result tables.

    Subjects differ in shape, skin, hair and performance; their tracking has errors, and their held-out sequence three parts:
    seen, recombined and beyond training. Started again after a kill it continues. Takes hours.
    """

    out: str
    """Folder for captures, runs and results.md."""

    methods: tuple[str, ...] = ()
    """Methods; default: those of `headbench demo`."""

    preset: str = "fast"
    """How much training, as for `headbench run`."""

    seeds: tuple[int, ...] = (0,)
    """Seeds of the training."""

    ablations: bool = False
    """Train ours with parts left out, too: each a run of its own on the same captures."""

    subjects: int = 10
    """How many of the suite's subjects, from the first; fewer than 6 allow no test of significance."""

    cameras: int = 8
    """Views of each, the held-out one included."""

    timesteps: int = 160
    """Of each subject; a quarter is held out."""

    size: str = "144x208"
    """Width x height of the images in pixels."""

    edition: Literal[2, 1] = 2
    """As for `headbench synth`."""

    tracking_error: float = 1.0
    """As for `headbench synth`."""

    def __post_init__(self) -> None:
        """Refuse sizes that are none."""
        parse_size(self.size)


@writes("out")
def suite(settings: SuiteSettings, progress: Progress = no_progress) -> Findings:
    """Compare methods on the suite's ten synthetic subjects: capture, train, measure, tables by region and part."""
    from .suite import run_suite

    return run_suite(settings, progress)
