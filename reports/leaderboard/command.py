"""``headbench report leaderboard``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from ...bench.contracts import Progress, no_progress
from ...bench.specs import CommandResult


@dataclass(frozen=True)
class LeaderboardSettings:
    """Make a page of all result bundles in a folder: a table for each set of frames, and their submitters.

    Bundles whose rows are of the same frames by the same protocol share a table, with the marks and tests of `headbench
    table`. Every bundle's digests are checked; `headbench verify BUNDLE` recomputes its values.
    """

    folder: tyro.conf.Positional[str]
    """Folder with bundles (*.zip) of `headbench bundle`."""

    out: str
    """Folder to write leaderboard.md and leaderboard.html into."""

    title: str = "Leaderboard"
    """Heading of the page."""


def leaderboard_build(settings: LeaderboardSettings, progress: Progress = no_progress) -> CommandResult:
    """Build a leaderboard page in Markdown and HTML from the result bundles in a folder."""
    from .page import build

    return build(Path(settings.folder), Path(settings.out), settings.title, progress)
