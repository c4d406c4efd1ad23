"""Settings of ``headbench lint``; light to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class LintSettings:
    """What to look at, and how strictly."""

    clip: Annotated[str, tyro.conf.Positional] = ""
    """Capture in the GaussianAvatars/VHAP layout: a UNION folder, a sequence folder, or the folder of one union."""

    head: str | None = None
    """Head model for captures that bring none: FLAME pickle or npz."""

    cy: Literal["auto", "top", "bottom", "centre"] = "auto"
    """How the principal point is read; auto takes the declared convention, else lets the images decide."""

    strict: bool = False
    """Exit with 1 on warnings too."""

    ignore: tuple[str, ...] = ()
    """Codes not to report, such as HB406."""

    list: bool = False
    """Explain every code and stop."""

    views: int = 48
    """Frames to decode for the checks of colour, mattes and tracking, spread over timesteps and cameras."""

    duplicates: int = 600
    """Images to decode in the search for near-duplicates between splits. Equal files are found among all."""

    thorough: bool = False
    """Decode every image for both; minutes for a recording of thousands of timesteps."""

    min_test_timesteps: int = 10
    """Shortest self-reenactment sequence that raises no warning."""
