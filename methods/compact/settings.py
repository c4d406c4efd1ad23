"""Settings of ``headbench compact``. Light to import."""

from __future__ import annotations

from dataclasses import dataclass, field

import tyro

from .encoding import Precision


@dataclass(frozen=True)
class CompactSettings:
    """Store an avatar of ours in about a fifteenth of its bytes."""

    avatar: tyro.conf.Positional[str]
    """Folder of the avatar, with its exact file."""

    out: str
    """Folder to write: the compact file, and the head model beside it."""

    compare: str | None = None
    """Capture that the avatar was trained on. Splats that none of its training poses shows are left out, and the
    quality is measured on its held-out frames."""

    head: str | None = None
    """Head model for a capture that brings none: FLAME pickle or npz."""

    frames: int = 8
    """Held-out frames to compare on, evenly spread over both held-out splits."""

    scale: int = 1
    """Enlarge the compared images so many times. Above 1 there is no truth to compare with, only the exact avatar."""

    precision: Precision = field(default_factory=Precision)
    """How finely each part is stored."""

    def __post_init__(self) -> None:
        if self.frames < 1 or self.scale < 1:
            raise ValueError(f"frames and scale must be at least 1, found {self.frames} and {self.scale}")
