"""The part of ``headbench track`` that is for video files."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ...bench.contracts import Progress
from ...bench.errors import InputError
from ...bench.io.files import check_output_folder
from ...bench.landmark_network import LandmarkNetwork
from ..clip import CaptureClip
from ..head.refit.command import target_head
from ..tracking.focal import FocalLength, estimate_focal
from ..tracking.network import NetworkLandmarks, head_embedding
from .clip import USUAL_FOCAL, VideoClip, open_video

if TYPE_CHECKING:
    from ..tracking.settings import TrackSettings

FRAMES = ".frames"
"""Folder of the frames of a video while it is tracked."""
NEEDED = ("head", "landmarks")


class OpenedVideo(NamedTuple):
    """A video to be tracked: its clip, its landmarks, and what is said of it, as data and in lines."""

    clip: CaptureClip
    landmarks: NetworkLandmarks
    data: dict[str, Any]
    lines: list[str]


@contextmanager
def opened_video(settings: TrackSettings, out: Path, progress: Progress) -> Iterator[OpenedVideo]:
    """The clip of a video with its focal length.

    Its frames are in ``out`` while the context lasts. Raises `InputError` for options that are missing, and as `open_video`.
    """
    path = Path(settings.capture)
    for name in NEEDED:
        if not getattr(settings, name):
            raise InputError("command line", f"--{name}", "a value, for the file of a video", "none")
    named = settings.head or ""
    head = target_head(named, "--head")
    network = LandmarkNetwork(Path(settings.landmarks))
    own = replace(settings, head=named if Path(named).exists() else None)  # a name of a head is for no reader
    teacher = own.open(settings.embedding, progress) if settings.embedding else None
    embedding = head_embedding(network, head, teacher, progress)
    check_output_folder(out)
    folder = out / FRAMES
    with _emptied(folder):
        video = open_video(path, settings, head, network, folder, progress)
        clip, focal = video.clip, None
        landmarks = NetworkLandmarks(network, embedding, clip, [*clip.cameras])
        if settings.focal is None:
            (camera,) = clip.cameras.values()
            side = max(video.info.width, video.info.height) * video.scale
            focal = estimate_focal(clip.head, camera, landmarks(sorted(clip.poses)), side)
            if focal.clear:
                clip = video.with_focal(focal.pixels / video.scale)
                landmarks = NetworkLandmarks(network, embedding, clip, [*clip.cameras])
        data, lines = _data(video, settings.focal, focal), _lines(video, settings.focal, focal)
        yield OpenedVideo(clip, landmarks, data, lines)


@contextmanager
def _emptied(folder: Path) -> Iterator[None]:
    """A new folder, without what a killed run left; removed when the block ends."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _data(video: VideoClip, given: float | None, focal: FocalLength | None) -> dict[str, Any]:
    return {
        "video": {
            **video.info._asdict(),
            "crop": [*video.crop],
            "scale": video.scale,
            "without_face": [*video.without_face],
            "focal": dict(zip(("pixels", "source"), _focal(video, given, focal))),
        }
    }


def _focal(video: VideoClip, given: float | None, focal: FocalLength | None) -> tuple[float, str]:
    """Focal length in pixels of the video, and where it is from."""
    if focal is None:
        return given or 0.0, "given"
    if focal.clear:
        return focal.pixels / video.scale, "estimated from landmarks"
    usual = USUAL_FOCAL * max(video.info.width, video.info.height)
    return usual, "assumed, since the landmarks do not determine it; give --focal if you know it"


def _lines(video: VideoClip, given: float | None, focal: FocalLength | None) -> list[str]:
    (camera,) = video.clip.cameras.values()
    pixels, source = _focal(video, given, focal)
    lines = [
        f"{len(video.clip.files)} frames of {camera.width}x{camera.height} pixels around the head",
        f"  video      {video.info.width}x{video.info.height} pixels, {video.info.rate:.3g} frames a second",
        f"  focal      {pixels:.0f} pixels of the video, {source}",
    ]
    if video.without_face:
        shown = ", ".join(map(str, video.without_face[:8])) + (" ..." if len(video.without_face) > 8 else "")
        lines.append(f"  left out   {len(video.without_face)} frames without a face: {shown}")
    return lines
