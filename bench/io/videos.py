"""Frames of a video file: upright, with square pixels, in sRGB's primaries, at a constant rate.

Decoded by PyAV, which unlike OpenCV gives the properties of a stream: pixels that are not square and mirrored ones are made
upright and square here; FFmpeg converts matrix and range of the colours.

Formats read:

- Videos. Written by FFmpeg (libavformat 58 and 61). Checked on the three videos of
  Zielon/metrical-tracker@c2a51724 and that of felixtaubner/cap4d@1f25e997.
- Videos of phones. Written by their cameras, with a display matrix or HDR. Not checked on a file of the program.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ..contracts import ByteArray
from ..errors import InputError, UnavailableError, install_extra

LEAST_SHARE = 0.9
"""Minimum fraction of the stated duration that must be decoded."""
SQUARE = 0.005
"""Maximum difference of the width of a pixel from its height, relative to it, that counts as rounding."""
HDR, BT2020 = (16, 18), 9
"""Transfers (PQ, HLG) and primaries whose colours are not those of a display in sRGB, by ITU-T H.273."""
TO_SDR = (
    'ffmpeg -i IN -vf "zscale=t=linear:npl=203,format=gbrpf32le,zscale=p=bt709,tonemap=hable:desat=0,'
    'zscale=t=bt709:m=bt709:r=tv,format=yuv420p" OUT.mp4'
)
SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")


class VideoInfo(NamedTuple):
    """Properties of a video file."""

    width: int
    """Of upright frames, pixels."""
    height: int
    rate: float
    """Mean number of frames a second."""
    frames: int
    """By duration and rate, which may not be exact."""


def is_video(path: Path) -> bool:
    """Whether a path names a file with the suffix of a video."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def probe_video(path: Path) -> VideoInfo:
    """Size and rate of a video. Raises `InputError` for another file."""
    _, first = next(_decoded(path))
    with _opened(path) as (_, stream, seconds):
        rate = float(stream.average_rate or stream.guessed_rate or 0)
        count = stream.frames if seconds is None else round(seconds * rate)  # without frames that are cut off
    if not 1.0 <= rate <= 1000.0:
        raise InputError(path, "frame rate", "1 to 1000 frames a second", f"{rate:g}")
    return VideoInfo(first.shape[1], first.shape[0], rate, count)


class TimedFrame(NamedTuple):
    """A frame of a video."""

    number: int
    """From 0, of all frames in the file."""
    time: float
    """From the first frame, seconds."""
    image: ByteArray
    """(H, W, 3) RGB, upright."""


def video_frames(path: Path, rate: float | None = None) -> Iterator[TimedFrame]:
    """Frames with their numbers and times, turned upright and made square as the file says.

    Of a video whose rate varies, or that has more than ``rate`` frames a second, the first frame from each multiple of
    1 / ``rate`` on is taken.

    ``rate``: Maximum number of frames a second; None for all frames.
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
    with _opened(path) as (container, stream, seconds):
        step = 1 / float(stream.average_rate or 25)
        ratio = float(stream.sample_aspect_ratio or 1)
        if stream.codec_context.color_trc in HDR or stream.codec_context.color_primaries == BT2020:
            raise _refused(path, "colours", "those of BT.709 or BT.601", "HDR or BT.2020", TO_SDR)
        if stream.metadata.get("alpha_mode") == "1":  # WebM, whose second layer is not decoded
            raise _refused(path, "alpha", "opaque frames", "transparent ones", _OPAQUE)
        first, now, count = None, 0.0, 0
        for frame in _frames(container, stream):
            now = step * count if frame.time is None else float(frame.time)
            first, count = now if first is None else first, count + 1
            yield max(0.0, now - first), _picture(path, frame, ratio)
        if first is None:
            raise _undecoded(path)
        if seconds is not None and now - first + step < LEAST_SHARE * seconds:
            remedy = "The file is damaged. Convert it again, for example with ffmpeg."
            found = f"{now - first + step:.3g} s, {count} frames"
            raise InputError(path, "", f"{seconds:.3g} s, as the file states", found, remedy)


_OPAQUE = (
    'ffmpeg -i IN -filter_complex "color=white[b];[b][0]scale2ref[b][v];[b][v]overlay=shortest=1" OUT.mp4'
)


def _frames(container: Any, stream: Any) -> Iterator[Any]:
    """Decoded frames without those that are damaged."""
    av = importlib.import_module("av")
    for packet in container.demux(stream):
        try:
            yield from packet.decode()
        except av.error.FFmpegError:
            continue


def _picture(path: Path, frame: Any, ratio: float) -> ByteArray:
    """(H, W, 3) RGB of a frame whose pixels are ``ratio`` times as wide as high, upright and with square pixels."""
    if frame.interlaced_frame:
        remedy = "ffmpeg -i IN -vf bwdif=mode=send_frame OUT.mp4"
        raise _refused(path, "frames", "progressive frames", "interlaced ones", remedy)
    parts = frame.format.components
    if any(part.is_alpha for part in parts) and frame.to_ndarray(format="rgba")[..., 3].min() < 255:
        raise _refused(path, "alpha", "opaque frames", "transparent pixels", _OPAQUE)
    if max(part.bits for part in parts) > 8:
        image = np.rint(frame.to_ndarray(format="rgb48le") / 257).astype(np.uint8)
    else:
        image = frame.to_ndarray(format="rgb24")
    if abs(ratio - 1) > SQUARE:  # the sparse direction is enlarged, so that no pixel is lost
        height, width = image.shape[:2]
        size = (round(width * max(1, ratio)), round(height * max(1, 1 / ratio)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(_upright(path, frame, image))


def _upright(path: Path, frame: Any, image: ByteArray) -> ByteArray:
    """The image turned and mirrored by the frame's display matrix, ISO 14496-12, 8.3.2."""
    matrices = [bytes(data) for data in frame.side_data if data.type.name == "DISPLAYMATRIX"]
    matrix = np.frombuffer(matrices[0], np.int32).reshape(3, 3)[:2, :2] / 65536 if matrices else np.eye(2)
    turn = np.rint(matrix)
    if np.abs(matrix - turn).max() > 0.01 or (np.abs(turn).sum(axis=0) != 1).any():
        remedy = "ffmpeg -i IN OUT.mp4"
        raise _refused(path, "orientation", "a multiple of 90 degrees", f"matrix {matrix.tolist()}", remedy)
    if turn[0, 0] == 0:
        image = image.swapaxes(0, 1)
    right, down = turn.sum(axis=0)  # of the columns and rows
    return image[:: int(down), :: int(right)]


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any, float | None]]:
    """Container, stream, and the stream's duration in seconds, None where it is not stated."""
    if not path.is_file():
        raise InputError(path, "", "a video", "no such file")
    try:
        av = importlib.import_module("av")
    except ImportError:
        raise UnavailableError(
            "Videos are read by PyAV, which is not installed.", install_extra("track")
        ) from None
    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, OSError):
        raise _undecoded(path) from None
    with container:
        stream = container.streams.best("video")
        if stream is None:
            raise _undecoded(path)
        stream.thread_type = "AUTO"
        seconds = None
        if stream.duration is not None:
            seconds = float(stream.duration * stream.time_base)
        elif container.duration is not None and len(container.streams) == 1:
            seconds = container.duration / 1e6
        yield container, stream, seconds


def _refused(path: Path, key: str, expected: str, found: str, command: str) -> InputError:
    return InputError(path, key, expected, found, f"Convert it: {command}")


def _undecoded(path: Path) -> InputError:
    return InputError(path, "", "a video that FFmpeg can decode, such as H.264 in mp4", "no frame")
