"""Settings of ``headbench track``, and its folder of intermediate results. Light to import."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ...bench.errors import InputError
from ...bench.io.files import TEMPORARY, check_output_folder, write_text
from ...bench.options import DependentOptions
from ..options import CaptureOptions, Cut

WORK = ".track"
"""Its name in the folder of ``--out``."""
TRACKER_VERSION = "5"
"""Part of the key of intermediate results; raise it when code of the tracker or the reader of videos changes them."""
_NOTE = "README.txt"
_TEXT = """headbench track continues from these files after an interruption and deletes them at the end.
Those of a video show the person. This folder can be deleted: the next call begins again then.
"""


def check_work_folder(folder: Path) -> None:
    """Raise `InputError` if the path has something not created by `make_work_folder`, since it will be deleted."""
    if folder.is_symlink():
        found = "a link"
    elif folder.is_dir():
        unfinished = all(path.name.startswith(TEMPORARY) for path in folder.iterdir())  # by a kill at once
        found = "" if (folder / _NOTE).is_file() or unfinished else "files of something else"
    else:
        found = "a file" if folder.exists() else ""
    if found:
        expected = "a folder that headbench track made, or none"
        raise InputError(folder, "", expected, found, "Move it away, or choose another --out.")


def make_work_folder(folder: Path) -> None:
    """Make the folder, with a note that says what it is."""
    check_work_folder(folder)
    check_output_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / _NOTE).is_file():
        write_text(folder / _NOTE, _TEXT)


USUAL_FOCAL, FOCAL_SPREAD = 2.5, 0.35
"""Prior of the focal length of a video: its median relative to the longer side of a frame, and the standard deviation of its logarithm.
Published trackers of videos start at 1.5 to 4.9 times the longer side."""
MASKLESS = "none"
"""Value of --masks that is no folder."""


@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """Options of `headbench track` for a video file; refused with captures."""

    segmentation: str = ""
    """Video: MediaPipe's selfie_segmentation.tflite, which finds the person in each frame; default without --masks: that of
    --fetch-networks."""

    masks: str = ""
    """Video: folder of masks instead, of the video's size, named by the number of the frame in the file (00000.png or 0000.jpg is
    the first frame, also where --rate takes fewer); or "none" to keep the room behind the person, which then counts in every
    metric."""

    cut: Cut = "bust-line"
    """Video: part of the person that is replaced by background, since no head model explains it: all below a line through the
    front of the neck's lower end, as VHAP's export does, or nothing."""

    parsing: str = ""
    """Video: folder of label images (19 classes of CelebAMask-HQ) named as --masks: clothes are cut by them instead."""

    focal: float | None = None
    """Video: focal length in pixels of its upright frames; default: estimated, which is inexact."""

    rate: float = 25.0
    """Video: maximum frame rate; frames of a faster video are skipped."""

    longest: int | None = None
    """Video: maximum number of frames that are used, from its beginning; default: all."""

    size: int = 512
    """Video: longest side of the frames after a crop around the head, pixels; smaller frames are not enlarged."""

    subject: str = ""
    """Video: name of the subject; default: that of the file."""

    held_out_frames: int | None = None
    """Video: number of last frames held out for self-reenactment; default: 350, or a quarter of fewer than 700."""

    def check_capture(self, path: str) -> None:
        """Raise `InputError` for an option that is given although the input is the capture ``path``."""
        for option in fields(VideoOptions):
            if getattr(self, option.name) != option.default:
                expected = "a video file as the input, without which it has no effect"
                raise InputError("command line", f"--{option.name.replace('_', '-')}", expected, path)

    def check_video(self) -> None:
        """Raise `ValueError` for a value out of range."""
        if self.focal is not None and not self.focal > 0:
            raise ValueError(f"focal is {self.focal}; more than 0")
        if not 1 <= self.rate <= 240:
            raise ValueError(f"rate is {self.rate}; from 1 to 240")
        if not 64 <= self.size <= 4096:
            raise ValueError(f"size is {self.size}; from 64 to 4096")
        if self.longest is not None and self.longest < 1:
            raise ValueError(f"longest is {self.longest}; at least 1")
        if self.held_out_frames is not None and self.held_out_frames < 1:
            raise ValueError(f"held_out_frames is {self.held_out_frames}; at least 1")


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
