"""Videos, written by OpenCV."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import cv2

from ..contracts import ByteArray
from ..errors import InputError
from .files import atomic_path

_H264, _MPEG4 = "avc1", "mp4v"


@functools.cache
def video_codec() -> str:
    """Codec that videos are written with: H.264 ("avc1") where OpenCV can, else MPEG-4 part 2 ("mp4v").

    OpenCV's wheels come without an H.264 encoder. They say so at length on the error stream, so another process
    asks.
    """
    asked = (
        "import cv2, sys, tempfile\n"
        "with tempfile.NamedTemporaryFile(suffix='.mp4') as file:\n"
        f"    code = cv2.VideoWriter_fourcc(*{_H264!r})\n"
        "    writer = cv2.VideoWriter(file.name, cv2.CAP_FFMPEG, code, 73.0, (64, 64))\n"
        "    sys.exit(not writer.isOpened())\n"
    )
    answer = subprocess.run([sys.executable, "-c", asked], capture_output=True, check=False)
    return _MPEG4 if answer.returncode else _H264


def write_video(path: Path, frames: Iterable[ByteArray], fps: float) -> str:
    """Write RGB (or one-channel) frames as an mp4; return the codec.

    Raises `InputError` for no frames, odd sizes, or where OpenCV cannot write a video.
    """
    codec = video_codec()
    writer: cv2.VideoWriter | None = None
    with atomic_path(path) as temporary:
        for frame in frames:
            height, width = frame.shape[:2]
            if writer is None:
                if width % 2 or height % 2:
                    expected = "even width and height, as the codec asks"
                    raise InputError(path, "size", expected, f"{width}x{height}")
                code = cv2.VideoWriter.fourcc(*codec)
                writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, code, fps, (width, height))
                if not writer.isOpened():
                    raise InputError(path, "", "a video that OpenCV can write", f"no encoder for {codec}")
            order = cv2.COLOR_GRAY2BGR if frame.ndim == 2 else cv2.COLOR_RGB2BGR
            writer.write(cv2.cvtColor(frame, order))
        if writer is None:
            raise InputError(path, "", "at least one frame", "none")
        writer.release()
    return codec
