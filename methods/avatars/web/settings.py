"""Settings of the export of avatars as web pages."""

from __future__ import annotations

from dataclasses import dataclass

from ....bench.options import DependentOptions
from ..settings import AvatarOptions


@dataclass(frozen=True)
class ExportHtmlSettings(AvatarOptions):
    """Write an avatar as one HTML file with sliders; it needs no network and no other file.

    For methods with splats, and browsers with WebGL2. Prints the size, and the PSNR relative to the avatar's own frames.
    """

    capture: str | None = None
    """Capture whose sequences the page plays. It also determines the pose of the head, the range of expressions without a
    name (otherwise -2 to 2), and the resolution to which a large picture is smoothed."""

    expressions: int = 10
    """Number of expressions with sliders: the named ones, else the single coefficients, that move the head farthest."""

    degree: int = 3
    """Degree of the spherical harmonics of view-dependent colours, 0 to 3; a lower degree takes fewer bytes."""

    title: str = ""
    """Title of the page; default: the names of subject and method."""

    dependent = (DependentOptions(("reader", "head", "cy", "set"), "capture"),)

    def __post_init__(self) -> None:
        if not 0 <= self.degree <= 3:
            raise ValueError(f"degree is {self.degree}; from 0 to 3")
        if self.expressions < 0:
            raise ValueError(f"expressions is {self.expressions}; at least 0")
