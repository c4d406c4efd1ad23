"""Settings of the check of captures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from ...bench.options import DependentOptions
from ..options import CaptureOptions


@dataclass(frozen=True)
class LintSettings(CaptureOptions):
    """Capture to check, and strictness."""

    clip: Annotated[str, tyro.conf.Positional] = ""
    """Capture, in a layout that a reader knows; of the reader ga a UNION folder, a sequence folder, or the union's."""

    strict: bool = False
    """Exit with 1 also for warnings."""

    ignore: tuple[str, ...] = ()
    """Codes not to report, such as HB406."""

    list: bool = False
    """Explain every code and stop; without other options."""

    views: int = 48
    """Frames to decode for the checks of colour, masks and tracking, spread over timesteps and cameras."""

    duplicates: int = 600
    """Number of images to decode in the search for near-duplicates between splits. Identical files are searched among all images."""

    camera_timesteps: int = 8
    """Number of timesteps on which each camera is compared with the others; 0 skips this."""

    thorough: bool = False
    """Decode every image, instead of --views and --duplicates, and measure cameras on 32 timesteps instead of
    --camera-timesteps; minutes for a recording of thousands of timesteps."""

    min_test_timesteps: int = 10
    """Shortest self-reenactment sequence that raises no warning."""

    def __post_init__(self) -> None:
        if self.camera_timesteps < 0:
            raise ValueError(f"camera_timesteps is {self.camera_timesteps}; 0 or more")

    dependent = (
        DependentOptions(
            (
                *("strict", "ignore", "views", "duplicates", "camera_timesteps", "thorough"),
                *("min_test_timesteps", "reader", "head", "cy", "set"),
            ),
            "list",
            False,
        ),
        DependentOptions(("views", "duplicates", "camera_timesteps"), "thorough", False),
    )
