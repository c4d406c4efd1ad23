"""Settings of the export of avatars as web pages."""

from __future__ import annotations

from dataclasses import dataclass

from ....bench.options import DependentOptions
from ..settings import AvatarOptions


@dataclass(frozen=True)
class ExportHtmlSettings(AvatarOptions):
    """Write one HTML file with an avatar in it and sliders that move it; it needs no network and no other file.

    Of methods with splats. Browsers with WebGL2 draw it. The findings tell the bytes, and what the page loses against the avatar's own frames.
    """

    capture: str | None = None
    """Capture whose poses say how far sliders go and how the head is held; without one they go to 2 both ways."""

    expressions: int = 10
    """Sliders for so many leading expressions."""

    degree: int = 3
    """Of the spherical harmonics that hold colours by viewing direction: 0 to 3. Fewer take fewer bytes."""

    title: str = ""
    """Of the page; default: the name of the subject."""

    dependent = (DependentOptions(("reader", "head", "cy", "set"), "capture"),)

    def __post_init__(self) -> None:
        if not 0 <= self.degree <= 3:
            raise ValueError(f"degree is {self.degree}; from 0 to 3")
        if self.expressions < 0:
            raise ValueError(f"expressions is {self.expressions}; at least 0")
