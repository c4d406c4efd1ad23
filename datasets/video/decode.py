"""Frames of a video file: upright, at a constant rate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray
from ...bench.errors import InputError

LEAST_SHARE = 0.9
"""Minimum fraction of the stated number of frames that must be decoded."""
SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")


class VideoInfo(NamedTuple):
    """Properties of a video file."""

    width: int
    """Of upright frames, pixels."""
    height: int
    rate: float
    """Mean number of frames a second."""
    frames: int
    """As the file says, which may not be exact."""


def is_video(path: Path) -> bool:
    """Whether a path names a file with the suffix of a video."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def probe_video(path: Path) -> VideoInfo:
    """Size and rate of a video. Raises `InputError` for another file."""
    with _opened(path) as capture:
        first = _next(capture)
        rate, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    if first is None:
        raise _undecoded(path)
    if not 1.0 <= rate <= 1000.0:
        raise InputError(path, "frame rate", "1 to 1000 frames a second", f"{rate:g}")
    return VideoInfo(first.shape[1], first.shape[0], float(rate), max(0, int(count)))


class TimedFrame(NamedTuple):
    """A frame of a video."""

    number: int
    """From 0, of all frames in the file."""
    time: float
    """From the first frame, seconds."""
    image: ByteArray
    """(H, W, 3) RGB, upright."""


def video_frames(path: Path, rate: float | None = None) -> Iterator[TimedFrame]:
    """Frames with their numbers and times, turned upright as the file says.

    Of a video whose rate varies, or that has more than ``rate`` frames a second, the first frame from each multiple of
    1 / ``rate`` on is taken.

    Parameters
    ----------
    rate : float | None
        Maximum number of frames a second; None for all frames.
    """
    following = 0
    size = None
    for number, (time, frame) in enumerate(_decoded(path)):
        size = size or frame.shape
        if frame.shape != size:
            expected = f"frames of {size[1]}x{size[0]} pixels, as the first"
            raise InputError(path, f"frame at {time:.2f} s", expected, f"{frame.shape[1]}x{frame.shape[0]}")
        # A hundredth of a frame, for times that are rounded in the file.
        if rate is None or time * rate >= following - 0.01:
            following = following + 1 if rate is None else int(np.floor(time * rate + 0.01)) + 1
            yield TimedFrame(number, time, frame)


def _decoded(path: Path) -> Iterator[tuple[float, ByteArray]]:
    with _opened(path) as capture:
        first, count = None, 0
        while (frame := _next(capture)) is not None:
            count += 1
            now = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            first = now if first is None else first
            yield max(0.0, now - first), frame
        if first is None:
            raise _undecoded(path)
        stated = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))  # an estimate in some formats
        if count < LEAST_SHARE * stated:
            remedy = "The file is damaged. Convert it again, for example with ffmpeg."
            raise InputError(path, "", f"{stated} frames, as the file states", f"{count}", remedy)


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    if not path.is_file():
        raise InputError(path, "", "a video", "no such file")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        yield capture
    finally:
        capture.release()


def _next(capture: cv2.VideoCapture) -> ByteArray | None:
    seen, frame = capture.read()
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8) if seen else None


def _undecoded(path: Path) -> InputError:
    return InputError(path, "", "a video that OpenCV can decode, such as H.264 in mp4", "no frame")
