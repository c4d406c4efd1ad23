"""The linter's errors that are checked before a run: those that change results and that no reader refuses."""

from __future__ import annotations

import os
from pathlib import Path

from ...bench.contracts import Clip, HeadAsset, no_progress
from ..clip import as_capture
from .catalogue import RULES
from .evidence import gather_clip
from .rules import Finding, apply
from .settings import LintSettings

VIEWS = 24
"""Most decoded frames, spread over timesteps and cameras."""
SPLITS = "HB2"
"""Codes of errors of the splits."""


def errors(clip: Clip) -> list[str]:
    """Code, fault, file and remedy of each error of the linter, from a part of the clip's frames.

    Errors of the splits are left out if the reader was asked to record them. Captures without a head model in FLAME's layout
    are not checked.
    """
    if not isinstance(clip.head, HeadAsset):
        return []
    recorded = any(step.parameters.get("leaks") for step in clip.steps)
    rules = [
        rule
        for rule in RULES
        if rule.severity == "error" and not rule.refused and not (recorded and rule.code.startswith(SPLITS))
    ]
    folder = Path(clip.subject)
    evidence = gather_clip(folder, as_capture(clip), LintSettings(views=VIEWS), no_progress, before_run=True)
    return [
        f"{found.code}: {found.message}{_where(found)}. {found.remedy}" for found in apply(rules, evidence)
    ]


def _where(found: Finding) -> str:
    """The file, if it is one."""
    return f" ({os.path.normpath(found.file)})" if os.path.isabs(found.file) else ""
