"""Settings of the command that renders avatars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ...bench.engine.config import AvatarFolder
from ...bench.options import DependentOptions


@dataclass(frozen=True)
class RenderSettings:
    """Render a stored avatar: frames of a task, or an orbit; as images, and as video."""

    avatar: AvatarFolder

    capture: str
    """Capture with the cameras and poses; of another subject, too, if its head model is that of the avatar."""

    out: str
    """Folder to write: FRAMES/SEQUENCE_TIMESTEP_CAMERA.png, as `headbench evaluate` reads them, or orbit/00000.png."""

    frames: Literal["self_reenactment", "novel_view", "train", "orbit"] = "self_reenactment"
    """Which frames of the capture, by split; or an orbit between and beyond its training cameras."""

    cameras: tuple[str, ...] = ()
    """Only these cameras; for an orbit, those that it passes."""

    timesteps: tuple[int, ...] = ()
    """Only these timesteps; for an orbit, its sequence of poses (default: the first of training)."""

    views: int = 60
    """Number of views of the orbit, with --frames orbit."""

    beyond: float = 30.0
    """With --frames orbit: angle beyond the outermost cameras, degrees."""

    video: bool = False
    """Also write videos, one for each sequence and camera. Needs PyAV (extra `video`)."""

    beside: bool = False
    """With --video of captured frames: show the captured image next to each."""

    fps: float = 25.0
    """With --video: frames per second."""

    method: str = ""
    """Method of the avatar as package.module:SPEC, where it is not registered."""

    reader: str = ""
    """Reader of the capture; default: the one that finds it."""

    head: str | None = None
    """Head model for captures without one: FLAME pickle or npz."""

    device: str = "cpu"
    """Rendering device."""

    dependent = (
        DependentOptions(("views", "beyond"), "frames", ("orbit",)),
        DependentOptions(("fps", "beside"), "video"),
        DependentOptions(("beside",), "frames", ("self_reenactment", "novel_view", "train")),
    )

    def __post_init__(self) -> None:
        if self.views < 1 or not 0.0 <= self.beyond < 180.0:
            raise ValueError("views is at least 1, beyond from 0 to less than 180 degrees")
        if not 0.0 < self.fps <= 1000.0:
            raise ValueError(f"fps is {self.fps}; above 0, at most 1000")
