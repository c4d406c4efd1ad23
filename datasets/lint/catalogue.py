"""All rules of the linter, in order of their codes.

The linter's errors that are checked before a run: those that change results and that no reader refuses.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

from ...bench.contracts import Clip, HeadAsset, no_progress
from ..clip import as_capture
from . import checks_cameras, checks_files, checks_images, checks_rig, checks_tracking
from .evidence import Evidence
from .rules import Finding, Rule, apply
from .settings import LintSettings

GROUPS = {
    "1": "files and frames",
    "2": "splits",
    "3": "backgrounds and masks",
    "4": "colour",
    "5": "cameras",
    "6": "head model and tracking",
    "7": "mesh against images",
}
"""Subject by the code's first digit."""

RULES = sorted(
    (
        rule
        for checks in (checks_cameras, checks_files, checks_images, checks_rig, checks_tracking)
        for rule in vars(checks).values()
        if isinstance(rule, Rule)
    ),
    key=lambda rule: rule.code,
)


log = logging.getLogger(__name__)

VIEWS = 24
"""Most decoded frames, spread over timesteps and cameras."""
TORSO = "HB704"
"""Code of the warning of a part of the person that no head model explains, which is shown before a run, too."""
SPLITS = "HB2"
"""Codes of errors of the splits."""


def errors(clip: Clip) -> list[str]:
    """Code, fault, file and remedy of each error of the linter, from a part of the clip's frames; `TORSO` is logged.

    Errors of the splits are left out if the reader was asked to record them. Captures without a head model in FLAME's layout
    are not checked.
    """
    if not isinstance(clip.head, HeadAsset):
        return []
    recorded = any(step.parameters.get("leaks") for step in clip.steps)
    rules = [
        rule
        for rule in RULES
        if rule.code == TORSO
        or (rule.severity == "error" and not rule.refused and not (recorded and rule.code.startswith(SPLITS)))
    ]
    folder = Path(clip.subject)
    evidence = Evidence.of_clip(
        folder, as_capture(clip), LintSettings(views=VIEWS), no_progress, before_run=True
    )
    errors = []
    for finding in apply(rules, evidence):
        text = f"{finding.code}: {finding.message}{_where(finding)}. {finding.remedy}"
        if finding.severity == "error":
            errors.append(text)
        else:
            log.warning("%s: %s", clip.subject, text)
    return errors


def _where(finding: Finding) -> str:
    """The file, if it is one."""
    return f" ({os.path.normpath(finding.file)})" if os.path.isabs(finding.file) else ""
