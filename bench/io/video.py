"""Videos: mp4 by OpenCV, H.264 by the program FFmpeg if that encoder is requested, WebM for browsers by
PyAV."""

from __future__ import annotations

import functools
import importlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from ..contracts import ByteArray
from ..errors import HeadbenchError, InputError, UnavailableError, install_extra
from .files import ROOM_BYTES, atomic_path
from .provenance import note

_H264, _MPEG4 = "avc1", "mp4v"


@functools.cache
def video_codec() -> str:
    """Codec of written videos: H.264 ("avc1") if OpenCV supports it, else MPEG-4 part 2 ("mp4v").

    OpenCV's wheels have no H.264 encoder and print long messages about it, so the check runs in another
    process.
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
    count = 0
    with atomic_path(path) as temporary:
        for frame in frames:
            height, width = frame.shape[:2]
            if writer is None:
                if width % 2 or height % 2:
                    expected = "even width and height, as the codec requires"
                    raise InputError(path, "size", expected, f"{width}x{height}")
                code = cv2.VideoWriter.fourcc(*codec)
                writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, code, fps, (width, height))
                if not writer.isOpened():
                    raise InputError(path, "", "a video that OpenCV can write", f"no encoder for {codec}")
            order = cv2.COLOR_GRAY2BGR if frame.ndim == 2 else cv2.COLOR_RGB2BGR
            writer.write(cv2.cvtColor(frame, order))
            count += 1
        if writer is None:
            raise InputError(path, "", "at least one frame", "none")
        writer.release()
        _check_whole(path, temporary, count)
    return codec


def _check_whole(path: Path, written: Path, count: int) -> None:
    """Raise an error if a video has fewer frames than were written, since OpenCV does not report a full disk."""
    capture = cv2.VideoCapture(str(written), cv2.CAP_FFMPEG)
    found = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
    complete = capture.isOpened() and found == count
    capture.release()
    if not complete:
        with written.open("ab") as stream:  # raises the system's error, if it persists
            stream.write(bytes(ROOM_BYTES))
            stream.flush()
            os.fsync(stream.fileno())
        raise InputError(path, "", f"a video of {count} frames after writing it", f"{found} frames")


def browser_encoder(path: Path = Path("video.webm")) -> Any:
    """The module that writes videos for browsers. Raises `UnavailableError` if it or the encoder for a name is missing."""
    try:
        av = importlib.import_module("av")
    except ImportError:
        raise UnavailableError(
            "Videos for browsers are written by PyAV, which is not installed.", install_extra("video")
        ) from None
    encoder = ENCODINGS[path.suffix.lower()].encoder
    if encoder not in av.codecs_available:
        raise UnavailableError(f"This PyAV has no encoder {encoder}.", "Name a video in .webm.")
    return av


class _Encoding(NamedTuple):
    """PyAV settings of a video container for browsers."""

    container: str
    encoder: str
    options: dict[str, str]
    pixels: str
    multiple: int
    """Width and height must be multiples of this."""


ENCODINGS = {
    ".webm": _Encoding("webm", "libvpx-vp9", {"crf": "16", "b": "0"}, "yuv444p", 1),
    ".mp4": _Encoding("mp4", "libx264", {"crf": "16"}, "yuv420p", 2),
}
"""Videos for browsers by file suffix: VP9 without chroma subsampling, and H.264 with it."""


def write_browser_video(path: Path, frames: Iterable[ByteArray], fps: float, kind: str) -> None:
    """Write (H, W, 3) RGB frames of one size as a video of constant quality, with a suffix of `ENCODINGS`.

    ``kind`` marks it in the tag COMMENT, see `provenance`.

    WebM has 44 dB at 2 kB a frame on the demo's renders. Raises `UnavailableError` without PyAV or its encoder, `InputError`
    for no frames and for an odd width or height of an mp4.
    """
    av, encoding = browser_encoder(path), ENCODINGS[path.suffix.lower()]
    stream: Any = None
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format=encoding.container) as container:
        container.metadata["comment"] = note(kind)
        for frame in frames:
            if stream is None:
                height, width = frame.shape[:2]
                if width % encoding.multiple or height % encoding.multiple:
                    expected = "even width and height, as the codec requires"
                    raise InputError(path, "size", expected, f"{width}x{height}", "Name a file in .webm.")
                rate = Fraction(fps).limit_denominator(1001)
                stream = container.add_stream(encoding.encoder, rate=rate, options=dict(encoding.options))
                stream.height, stream.width = height, width
                stream.pix_fmt = encoding.pixels
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        if stream is None:
            raise InputError(path, "", "at least one frame", "none")
        container.mux(stream.encode())


def ffmpeg() -> str:
    """The program ffmpeg: that on PATH, else the one in the package imageio-ffmpeg.

    Raises `UnavailableError` if neither is found.
    """
    found = shutil.which("ffmpeg")
    if found is None:
        try:
            found = str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
        except (ImportError, RuntimeError):
            remedy = "Install it: apt-get install ffmpeg, or pip install imageio-ffmpeg."
            raise UnavailableError(
                "H.264 is encoded by the program ffmpeg, which is not here.", remedy
            ) from None
    return found


def encode_h264(path: Path, frames: Iterable[ByteArray], size: tuple[int, int], fps: float, crf: int) -> None:
    """Encode (H, W, 3) RGB frames of (width, height) ``size`` as H.264, YUV 4:2:0 of 8 bits, by a constant rate factor.

    Raises `UnavailableError` without ffmpeg, `HeadbenchError` with its message if it fails, and `InputError`
    for a frame of another size.
    """
    width, height = size
    with atomic_path(path) as temporary, tempfile.TemporaryFile() as errors:
        command = [ffmpeg(), "-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        command += ["-r", f"{fps:g}", "-i", "-", "-an", "-vcodec", "libx264", "-pix_fmt", "yuv420p"]
        command += ["-crf", str(crf), "-y", str(temporary)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors)
        assert process.stdin is not None
        try:
            for number, frame in enumerate(frames):
                if frame.shape != (height, width, 3):
                    found = f"{frame.shape[1]}x{frame.shape[0]}"
                    raise InputError(path, f"frame {number}", f"{width}x{height} pixels", found)
                process.stdin.write(frame.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # it has ended, and its message gives the reason
        except BaseException:
            process.kill()
            raise
        finally:
            code = process.wait()
        if code:
            errors.seek(0)
            said = errors.read(2000).decode(errors="replace").strip()
            raise HeadbenchError(f"{path}: ffmpeg failed: {said or f'exit code {code}'}")
