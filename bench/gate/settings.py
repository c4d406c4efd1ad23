"""Settings of the comparison with a baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..options import DependentOptions

Captures = Literal["same", "remade"]


@dataclass(frozen=True, kw_only=True)
class BaselineOptions:
    """Comparison of a run with a baseline file."""

    baseline: str | None = None
    """Compare one run, or what `headbench evaluate` wrote, with this baseline file (JSON), which is kept under version
    control. Exit code 0: no value is worse; 1: a value is worse; 3: results or baseline missing or invalid.
    """

    update: bool = False
    """With --baseline: write the results into the file instead of judging them; tolerances that it has are kept."""

    captures: Captures | None = None
    """With --update: `same` (default) requires captures with the same fingerprint; `remade` is for captures
    that are synthesised again for every run: everything except the fingerprint must be the same."""

    judge_speed: bool = False
    """With --baseline: also judge metrics that depend on the machine and its load (frames per second, milliseconds, training
    time, memory), where the baseline was measured on a machine of the same kind. Without it they are shown, but do not affect
    the exit code."""

    junit: str | None = None
    """With --baseline: also write a JUnit XML file: one test case for every task, method, subject and metric."""

    markdown: str | None = None
    """With --baseline: also write a Markdown summary."""


DEPENDENT = (
    DependentOptions(("update", "captures", "judge_speed", "junit", "markdown"), "baseline"),
    DependentOptions(("captures",), "update"),
    DependentOptions(("judge_speed", "junit", "markdown"), "update", False),
)
"""Options that have no effect without, or with, another one."""
