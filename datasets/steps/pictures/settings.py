"""Settings of ``headbench steps``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro


@dataclass(frozen=True)
class StepsSettings:
    """Draw the jaw bases and the expression classes that a capture's training frames give."""

    capture: tyro.conf.Positional[str]
    """Capture in the GaussianAvatars/VHAP layout."""

    out: str
    """Folder for jaw_bases.png, expression_classes.png and steps.json."""

    bases: int = 16
    """Jaw bases at most."""

    classes: int = 16
    """Expression classes at most."""

    seed: int = 0
    """Seeds the choice of landmarks in long captures."""

    variant: Literal["paper", "official"] = "paper"
    """"official" shows what the published code makes: jaw bases from held-out poses (a leak, and said so)."""

    head: str | None = None
    """Head model for a capture that brings none: FLAME pickle or npz."""
