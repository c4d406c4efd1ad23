"""Settings of the compact format of avatars."""

from __future__ import annotations

from dataclasses import dataclass, field

from ....bench.engine.config import AvatarFolder
from ....bench.options import DependentOptions
from ....datasets.options import CaptureOptions
from .precision import Precision


@dataclass(frozen=True)
class CompactSettings(CaptureOptions):
    """Store an avatar of a native method by the common codec: quantised by visible effect, and compressed."""

    avatar: AvatarFolder

    out: str
    """Folder to write: the compact file, and the head model beside it."""

    compare: str | None = None
    """Capture that the avatar was trained on. Steps follow the visibility of splats in its training views, and quality is
    measured on held-out frames."""

    frames: int = 8
    """With --compare: held-out frames to compare on, evenly spread over both held-out splits."""

    scale: int = 1
    """With --compare: factor by which the images are enlarged. Above 1 there is no ground truth to compare with, only the exact
    avatar."""

    precision: Precision = field(default_factory=Precision)
    """Quantisation steps of each part."""

    dependent = (DependentOptions(("frames", "scale", "reader", "head", "cy", "set"), "compare"),)

    def __post_init__(self) -> None:
        if self.frames < 1 or self.scale < 1:
            raise ValueError(f"frames and scale must be at least 1, found {self.frames} and {self.scale}")
