"""Settings of ``headbench tongue``; light to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class TongueSettings:
    """Which capture to look at, and how."""

    capture: Annotated[str, tyro.conf.Positional]
    """Capture in the GaussianAvatars/VHAP layout, or a folder of several subjects' captures."""

    out: str
    """Folder for tongue.yaml and the contact sheets. Overrides in a tongue.yaml that is there are kept."""

    head: str | None = None
    """Head model for captures that bring none: FLAME pickle or npz."""

    masks: str | None = None
    """FLAME_masks.pkl, for a head model without regions."""

    cy: Literal["auto", "top", "bottom", "centre"] = "auto"
    """How the principal point is read; auto takes the declared convention, else lets the images decide."""

    threshold: float | None = None
    """Area in mm2 from which on a frame is left out; by default chosen for each subject between 20 and 60."""

    cameras: int = 4
    """How many cameras to look through: those that the mouth faces most."""

    frames: int = 60
    """How many frames to show on a contact sheet: the highest areas."""
