"""Options of every command that opens the capture of a run. Light to import."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Where a run's files are now, and what may be loaded."""

    data: str | None = None
    """The run's capture, if it is no longer where the run found it."""

    head: str | None = None
    """The head model that the run's reader was given, if it is no longer where it was."""

    trust: bool = False
    """Import the modules that the run folder names for methods, metrics and readers which are not registered; they can
    run any code."""
