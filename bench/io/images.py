"""Decoding and encoding of images: Pillow reads headers, OpenCV pixels.

Pixels are read as stored, since intrinsics refer to stored pixels: orientation tags, colour profiles
and gamma are ignored. Palettes are applied. Alpha channels are those of PNG: RGBA, grey with alpha, or a
tRNS chunk.
"""

from __future__ import annotations

import importlib
import io
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import cv2
import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from ..contracts import ByteArray, FloatArray
from ..errors import HeadbenchError, InputError, UnavailableError, install_extra
from .files import atomic_path, open_regular, reading, write_bytes
from .provenance import mark_png, note


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
    program = shutil.which("ffmpeg")
    if program is None:
        try:
            program = str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
        except (ImportError, RuntimeError):
            remedy = "Install it: apt-get install ffmpeg, or pip install imageio-ffmpeg."
            raise UnavailableError(
                "H.264 is encoded by the program ffmpeg, which is not here.", remedy
            ) from None
    return program


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


_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by colour type (PNG specification, 11.2.2)
_PNG_TABLE = 3
_PNG_END, _JPEG_END = b"IEND\xaeB`\x82", b"\xff\xd9"
_TAIL_BYTES = 64  # some encoders add padding after the end marker
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)  # does not occur in the data of a scan


@dataclass(frozen=True)
class ImageInfo:
    """Header of an image file; 8 bits per channel."""

    width: int
    height: int
    channels: int
    format: str = field(default="", compare=False)
    """"PNG" or "JPEG"."""
    table: bool = field(default=False, compare=False)
    """Whether pixels are stored as palette indices."""
    transparent: int | None = field(default=None, compare=False)
    """Level, from 0 to 255, that is transparent in a grey image, which OpenCV ignores."""

    @property
    def has_alpha(self) -> bool:
        """Whether the image has transparency: an alpha channel, or PNG's chunk tRNS."""
        return self.channels in (2, 4)


def probe_image(path: Path, *, decode: bool = False) -> ImageInfo:
    """Read the size of a PNG or JPEG and check that the file is complete.

    Needs only a few small reads; ``decode`` also decodes the pixels, which detects damage in the middle. Bytes after the end
    of the image are ignored.
    """
    with open_regular(path, "an image file") as stream:
        info = _header(path, stream)
        if decode:
            _decode(path, stream, info)
    return info


UPRIGHT = 1
"""Orientation of pixels that are stored as they are shown."""


def orientation_of(path: Path) -> int:
    """The orientation in the EXIF data of a JPEG, which no function here applies."""
    with reading(path, "a JPEG with readable EXIF data"), Image.open(path) as image:
        return int(image.getexif().get(ExifTags.Base.Orientation, UPRIGHT))


def read_pixels(path: Path, size: tuple[int, int] | None = None) -> ByteArray:
    """Decode a PNG or JPEG as it is stored.

    Parameters
    ----------
    size : tuple[int, int] | None
        Required (width, height).

    Returns
    -------
    ByteArray
        8-bit (H, W) grey, (H, W, 3) BGR, or (H, W, 4) BGR with straight alpha if the file has
        transparency.
    """
    with open_regular(path, "an image file") as stream:
        info = _header(path, stream)
        if size is not None and (info.width, info.height) != size:
            raise InputError(path, "", f"{size[0]}x{size[1]} pixels", f"{info.width}x{info.height}")
        return _decode(path, stream, info)


def _decode(path: Path, stream: BinaryIO, info: ImageInfo) -> ByteArray:
    """Decode a file that `_header` has accepted."""
    stream.seek(0)
    try:
        # Only with this flag does OpenCV ignore orientation tags.
        pixels = cv2.imdecode(np.frombuffer(stream.read(), np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(path, "", "an image that decodes", f"damaged data ({error.err})"[:200]) from error
    if pixels is None or pixels.dtype != np.uint8 or pixels.shape[:2] != (info.height, info.width):
        raise InputError(path, "", "an image that decodes", "damaged data")
    levels = pixels.astype(np.uint8, copy=False)
    if info.transparent is not None:
        alpha = np.where(levels == info.transparent, 0, 255)
        return np.dstack([levels, levels, levels, alpha]).astype(np.uint8)
    if info.channels == 3 and levels.shape[2:] == (4,):
        return np.ascontiguousarray(levels[..., :3])  # a palette of opaque colours
    return levels


def _header(path: Path, stream: BinaryIO) -> ImageInfo:
    head = stream.read(33)
    if not head:
        raise InputError(path, "", "an image", "an empty file")
    expected, remedy = "a PNG or JPEG image", "Convert it, for example to PNG."
    stream.seek(0)
    with reading(path, expected):
        try:
            image = Image.open(stream)
        except UnidentifiedImageError as error:
            raise InputError(path, "", expected, f"a file that starts with {head[:16]!r}", remedy) from error
    if image.format not in ("PNG", "JPEG", "MPO"):  # MPO: a JPEG with previews behind it
        raise InputError(path, "", expected, f"{image.format} data", remedy)
    info = _png_info(path, image, head) if image.format == "PNG" else _jpeg_info(path, image)
    if not _is_whole(stream, info.format):
        raise InputError(path, "", f"a whole {info.format}", "a truncated file")
    return info


def _png_info(path: Path, image: Image.Image, head: bytes) -> ImageInfo:
    depth, colour = head[24], head[25]
    if depth > 8:
        raise InputError(
            path, "", "8 bits per channel", f"bit depth {depth}, colour type {colour}", "Save it with 8 bits."
        )
    if getattr(image, "is_animated", False):
        raise InputError(path, "", "a single image", "an animated PNG", "Export its frames one by one.")
    channels, alpha = _PNG_CHANNELS[colour], image.info.get("transparency")
    if channels in (1, 3) and alpha is not None:
        channels += not isinstance(alpha, bytes) or alpha != b"\xff" * len(alpha)
    level = alpha % 2**depth * 255 // (2**depth - 1) if channels == 2 and colour == 0 else None
    return ImageInfo(image.width, image.height, channels, "PNG", colour == _PNG_TABLE, level)


def _jpeg_info(path: Path, image: Image.Image) -> ImageInfo:
    channels = len(image.getbands())
    if channels not in (1, 3):
        found = f"{channels} components, CMYK or YCCK"
        remedy = "Convert it to RGB by its colour profile, for example to PNG."
        raise InputError(path, "", "a JPEG of grey or RGB", found, remedy)
    return ImageInfo(image.width, image.height, channels, "JPEG")


def _is_whole(stream: BinaryIO, format: str) -> bool:
    """Whether the image ends before the file does; cameras and phones append previews and videos."""
    end = _PNG_END if format == "PNG" else _JPEG_END
    stream.seek(max(0, stream.seek(0, io.SEEK_END) - _TAIL_BYTES))
    if end in stream.read():
        return True
    stream.seek(0)
    content = stream.read()
    if format == "PNG":
        return end in content
    place = 2
    while match := _JPEG_MARKER.search(content, place):
        place = match.end()
        if match.group() == _JPEG_END:
            return True
        place += int.from_bytes(content[place : place + 2], "big")
    return False


def quantise(rgb: FloatArray) -> ByteArray:
    """Round colours in [0, 1] to the nearest 8-bit level; values outside are clamped.

    Truncating (``rgb * 255`` cast to an integer) would darken by half a level on average.
    """
    if not np.issubdtype(rgb.dtype, np.floating):
        raise InputError("render", "rgb", "a floating-point array in [0, 1]", str(rgb.dtype))
    finite = np.isfinite(rgb)
    if not finite.all():
        found = f"{rgb.size - int(finite.sum())} of {rgb.size} values infinite or not a number"
        raise InputError("render", "rgb", "finite colours", found)
    return np.rint(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8)


def encode_image(image: ByteArray, suffix: str, options: Sequence[int] = (), *, place: Path | str) -> bytes:
    """Encode (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA, 8-bit, in the format that the suffix names.

    ``options`` are OpenCV's, ``place`` is named in errors.
    """
    order = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}.get(image.shape[2]) if image.ndim == 3 else None
    try:
        stored = image if order is None else cv2.cvtColor(image, order)
        done, encoded = cv2.imencode(suffix, stored, [*options])
    except cv2.error:
        done = False
    if not done:
        expected = f"an image that the format {suffix} can hold"
        raise InputError(place, "", expected, f"shape {image.shape}, {image.dtype}")
    return encoded.tobytes()


def write_png(path: Path, image: ByteArray, kind: str = "") -> bytes:
    """Write an (H, W, 3) 8-bit sRGB image atomically; return the file's content.

    ``kind`` marks it, see `provenance`; "" for frames that metrics are computed from.
    """
    content = encode_image(image, ".png", (cv2.IMWRITE_PNG_COMPRESSION, 3), place=path)
    content = mark_png(content, kind) if kind else content
    write_bytes(path, content)
    return content


def read_bgr(path: Path, size: tuple[int, int] | None = None) -> ByteArray:
    """Read an (H, W, 3) 8-bit image in BGR order, without its alpha."""
    pixels = read_pixels(path, size)
    if pixels.ndim == 3 and pixels.shape[2] == 3:
        return pixels
    order = cv2.COLOR_GRAY2BGR if pixels.ndim == 2 else cv2.COLOR_BGRA2BGR
    return cv2.cvtColor(pixels, order).astype(np.uint8, copy=False)


def read_png(path: Path) -> ByteArray:
    """Read an (H, W, 3) 8-bit sRGB image, without its alpha."""
    pixels = read_pixels(path)
    orders = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    order = orders[1 if pixels.ndim == 2 else pixels.shape[2]]
    return np.asarray(cv2.cvtColor(pixels, order), dtype=np.uint8)
