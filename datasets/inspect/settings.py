"""Settings of ``headbench inspect``; light to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class InspectSettings:
    """Which capture, and how much of it to show."""

    clip: Annotated[str, tyro.conf.Positional]
    """Capture in the GaussianAvatars/VHAP layout: a UNION folder, a sequence folder, or the folder of one union."""

    out: str = "inspection"
    """Folder for inspection.png and inspection.json."""

    head: str | None = None
    """Head model for captures that bring none: FLAME pickle or npz."""

    cy: Literal["auto", "top", "bottom", "centre"] = "auto"
    """How the principal point is read; auto takes the declared convention, else lets the images decide."""

    timesteps: int = 3
    """Rows of overlays."""

    cameras: int = 4
    """Columns of overlays: held-out cameras first, then evenly over the rig."""
