"""Settings of ``headbench report leaderboard``."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from ...bench.engine.config import RunOptions
from ...bench.executors.options import ExecutionOptions


@dataclass(frozen=True)
class LeaderboardSettings(RunOptions, ExecutionOptions):
    """Make a page of all result bundles in a folder: a table for each set of frames, and their submitters.

    Bundles with the same frames and protocol share a table, with the marks and tests of `headbench table`. Results of different
    bundles are never merged. Metrics of frames are recomputed from renders as by `headbench verify`; only values that were
    verified are ranked. Bundles of synthetic captures need no --data.
    """

    folder: tyro.conf.Positional[str]
    """Folder with bundles (*.zip) of `headbench bundle`."""

    out: str
    """Folder to write leaderboard.md and leaderboard.html into, and results of --recompute, which are kept."""

    title: str = "Leaderboard"
    """Heading of the page."""

    recompute: tuple[str, ...] = ()
    """File names of bundles to train again from their seeds and settings, on captures that are made again. Check the settings
    first: they decide how long this takes."""
