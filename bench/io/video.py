"""Videos: H.264 by the program FFmpeg, WebM and mp4 for browsers by PyAV."""

from __future__ import annotations

import importlib
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

from ..contracts import ByteArray
from ..errors import HeadbenchError, InputError, UnavailableError, install_extra
from .files import atomic_path
from .provenance import note


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
