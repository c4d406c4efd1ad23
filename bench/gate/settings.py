"""Settings of the comparison with a baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro

from ..options import DependentOptions

Captures = Literal["same", "remade"]


@dataclass(frozen=True)
class GateSettings:
    """Hold the results of a run against a baseline file.

    Exit code 0: nothing got worse; 1: something did; 2: wrong usage; 3: results or baseline missing or invalid.
    """

    results: tyro.conf.Positional[str]
    """Folder of a finished run, or of `headbench evaluate`."""

    baseline: str
    """Baseline file (JSON), to be kept under version control."""

    update: bool = False
    """Write the results into the baseline instead of judging them; tolerances already in the file are kept."""

    captures: Captures | None = None
    """With --update: `same` (default) demands the very same captures, by fingerprint, ever after; `remade` is for ones
    synthesised again for every run, whose pictures differ in last bits between processors: all else must be the same."""

    judge_speed: bool = False
    """Also judge metrics that depend on the machine and its load (frames per second, milliseconds, training time, memory),
    where the baseline was measured on a machine of the same kind. Without it they are shown and decide nothing."""

    junit: str | None = None
    """Also write a JUnit XML file: one test case for every task, method, subject and metric."""

    markdown: str | None = None
    """Also write a Markdown summary."""

    dependent = (
        DependentOptions(("captures",), "update"),
        DependentOptions(("judge_speed", "junit", "markdown"), "update", False),
    )
