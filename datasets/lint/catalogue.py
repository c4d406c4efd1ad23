"""All rules of the linter, in order of their codes."""

from __future__ import annotations

from . import checks_cameras, checks_files, checks_images, checks_tracking
from .rules import Rule

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
        for checks in (checks_cameras, checks_files, checks_images, checks_tracking)
        for rule in vars(checks).values()
        if isinstance(rule, Rule)
    ),
    key=lambda rule: rule.code,
)
