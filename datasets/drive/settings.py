"""Settings of ``headbench drive``. Light to import."""

from __future__ import annotations

from dataclasses import dataclass

from ...bench.engine.config import AvatarFolder
from ...bench.options import DependentOptions
from ..options import CaptureOptions

MOST_SIZE = 4096


@dataclass(frozen=True)
class DriveSettings(CaptureOptions):
    """Drive a stored avatar with a signal, and write a video, or a capture of its frames and FLAME parameters. Prints
    jitter, identity spill, lip closure and latency, and the channels of the signal without effect."""

    avatar: AvatarFolder

    signal: str
    """File or folder of the signal: FLAME coefficients (npz, JSON), 52 blendshapes (CSV, JSON), a folder of FLAME
    parameters, a capture, or any table with --map."""

    out: str
    """File to write in .mp4 or .webm (extra `video`), or folder: a capture with frames and FLAME parameters."""

    form: str = ""
    """Format of the signal; default: the one that recognises it."""

    signal_head: str = ""
    """Head model of the signal's coefficients or blendshapes: 2020 or 2023 (the embedded procedural heads), the file of a
    head model, or "avatar" for that of the avatar."""

    map: str = ""
    """YAML file {column: {coefficient: weight}} for your own tables; coefficients are expression.0, jaw.0, eyes.0, eyelids.0,
    neck.0, rotation.0, translation.0, named expressions of the head, or ARKit's names."""

    sequence: str = ""
    """Driving sequence, if the signal is a capture; required if it has several."""

    capture: str = ""
    """Capture of the avatar, whose camera and mean head pose are used; default: a camera in front of the head."""

    camera: str = ""
    """With --capture: camera; default: the first that is held out, else the first."""

    size: int = 512
    """Without --capture: width and height of the image, pixels."""

    fps: float | None = None
    """Frames per second of the result. Default: those of the signal's times, else 25. A signal with times is resampled; one
    without has these."""

    smooth: float = 0.0
    """Window of a Savitzky-Golay filter of order 2, seconds; 0 leaves the signal as it is."""

    neutral: int | None = None
    """Frame, from 0, that shows the neutral face: its expression is subtracted from all frames."""

    still_head: bool = False
    """Leave out rotation and translation of the head."""

    method: str = ""
    """Method of the avatar as package.module:SPEC, where it is not registered."""

    device: str = "cpu"
    """Rendering device."""

    dependent = (
        DependentOptions(("camera",), "capture"),
        DependentOptions(("size",), "capture", False),
    )

    def __post_init__(self) -> None:
        if self.fps is not None and not 0.0 < self.fps <= 1000.0:
            raise ValueError(f"fps is {self.fps}; above 0, at most 1000")
        if not 0.0 <= self.smooth <= 60.0:
            raise ValueError(f"smooth is {self.smooth}; from 0 to 60 seconds")
        if not 16 <= self.size <= MOST_SIZE or self.size % 2:
            raise ValueError(f"size is {self.size}; even, from 16 to {MOST_SIZE}")
        if self.neutral is not None and self.neutral < 0:
            raise ValueError(f"neutral is {self.neutral}; at least 0")
