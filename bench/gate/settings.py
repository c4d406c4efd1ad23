"""Settings of ``headbench gate``. Light to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro

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

    junit: str | None = None
    """Also write a JUnit XML file: one test case for every task, method, subject and metric."""

    markdown: str | None = None
    """Also write a Markdown summary."""

    def __post_init__(self) -> None:
        """Refuse what contradicts itself."""
        if self.captures is not None and not self.update:
            raise ValueError("--captures is written into the baseline: give it with --update")
