"""Settings of the head tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from ...bench.options import DependentOptions
from ..options import CaptureOptions
from ..video.settings import VideoOptions


@dataclass(frozen=True)
class TrackSettings(VideoOptions, CaptureOptions):
    """Settings of ``headbench track``."""

    capture: Annotated[str, tyro.conf.Positional] = ""
    """Capture in a layout that a reader knows, whose images, cameras and head model are used; or the file of a video of one
    person."""

    out: str = ""
    """Folder for the tracked capture, track.json and overlay.png."""

    cameras: tuple[str, ...] = ()
    """Ids of the cameras whose images are used; default: all. One is enough."""

    landmarks: str = ""
    """MediaPipe's face_landmark.tflite, which needs ai-edge-litert; default: of a video, that of --fetch-networks; of a capture,
    vertices of its own tracked mesh with the error of such a network."""

    fetch_networks: bool = False
    """Only download MediaPipe's networks of landmarks, faces and masks (Apache-2.0) into the cache, where videos use them."""

    embedding: str = ""
    """Capture of another subject with exact tracking in the same head model, from which the positions of the network's
    landmarks on the mesh are learnt; default: renders of the head model. Only with --landmarks."""

    against: str = ""
    """Capture with the exact tracking, to print errors in millimetres by region."""

    program: Annotated[Literal["light", "vhap", "pixel3dmm"], tyro.conf.arg(name="with")] = "light"
    """Tracker: that of headbench, or for a video file your own installation of VHAP or Pixel3DMM, which need an NVIDIA GPU."""

    checkout: str = ""
    """With vhap or pixel3dmm: folder of its repository."""

    python: str = "python3"
    """With vhap or pixel3dmm: interpreter of its environment."""

    seed: int = 0
    """Seed of the errors of simulated landmarks."""

    dependent = (
        DependentOptions(("landmarks", "embedding", "cameras", "against", "seed"), "program", ("light",)),
        DependentOptions(
            ("segmentation", "masks", "cut", "parsing", "focal", "rate", "longest", "size"),
            "program",
            ("light",),
        ),
        DependentOptions(("python",), "checkout"),
    )

    def __post_init__(self) -> None:
        self.check_video()
        if self.fetch_networks == bool(self.capture or self.out) or bool(self.capture) != bool(self.out):
            raise ValueError("CAPTURE and --out, or --fetch-networks alone, are needed")
        if (self.program == "light") != (not self.checkout):
            raise ValueError("--with vhap or pixel3dmm and --checkout need each other")
