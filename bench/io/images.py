"""Images: files from outside are checked against bounds before any pixel is decoded; frames are written as PNG."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from ..contracts import ByteArray, FloatArray
from ..errors import InputError
from .files import open_regular, write_bytes
from .provenance import mark_png

MAX_PIXELS = 2**25
"""Of an image, as in 8192 x 4096: a header of a few bytes can declare any size, and decoding takes its memory."""
MAX_EXTRA = 2**26
"""Bytes of a file besides 8 for each pixel: colour profiles, previews. Holes in a file take no room on a disk."""
MAX_SCANS = 100
"""Of a progressive JPEG, which has about ten: a few bytes ask for a pass over all pixels."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by colour type (PNG specification, 11.2.2)
_DEFLATE_RATIO = 1040  # bytes out of one that went in are 1032 at most
_JPEG_START, _JPEG_END, _JPEG_SCAN = b"\xff\xd8", b"\xff\xd9", b"\xff\xda"
# Start-of-frame markers: SOF0..SOF15 but DHT (C4), JPG (C8) and DAC (CC), which share the range.
_JPEG_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_TAIL_BYTES = 64  # some encoders pad behind the end marker


@dataclass(frozen=True)
class ImageInfo:
    """What the header of an image file says; 8 bits per channel."""

    width: int
    height: int
    channels: int

    @property
    def has_alpha(self) -> bool:
        """Whether the file has an alpha channel, beside grey or RGB."""
        return self.channels in (2, 4)


def probe_image(path: Path, *, decode: bool = False) -> ImageInfo:
    """Read the size of a PNG or JPEG and make sure that the file is whole.

    Costs two small reads; ``decode`` decodes the pixels too and so finds damage in the middle. Raises
    `InputError` for a missing, empty, foreign or truncated file, more than 8 bits per channel, more than
    `MAX_PIXELS`, and more pixels than the file has bytes for.
    """
    with open_regular(path, "an image file") as stream:
        info = _probe(path, stream)
        if decode:
            _decode(path, stream, cv2.IMREAD_UNCHANGED)
    return info


def read_pixels(
    path: Path, flags: int = cv2.IMREAD_UNCHANGED, size: tuple[int, int] | None = None
) -> ByteArray:
    """Decode a PNG or JPEG as OpenCV has it, (H, W) or (H, W, C) in BGR order.

    Parameters
    ----------
    flags : of ``cv2.imdecode``.
    size : (width, height) it has to have.

    Raises
    ------
    InputError
        Where `probe_image` does, for another size, and for damage that keeps it from being decoded.
    """
    with open_regular(path, "an image file") as stream:
        info = _probe(path, stream)
        if size is not None and (info.width, info.height) != size:
            raise InputError(path, "", f"{size[0]}x{size[1]} pixels", f"{info.width}x{info.height}")
        return _decode(path, stream, flags)


def _decode(path: Path, stream: BinaryIO, flags: int) -> ByteArray:
    """Decode what `_probe` has accepted."""
    stream.seek(0)
    content = stream.read()
    if content.startswith(_JPEG_START) and content.count(_JPEG_SCAN) > MAX_SCANS:
        raise InputError(path, "", f"a JPEG of at most {MAX_SCANS} scans", f"{content.count(_JPEG_SCAN)}")
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error as error:
        raise InputError(path, "", "an image that decodes", f"damaged data ({error.err})"[:200]) from error
    if pixels is None or pixels.dtype != np.uint8:
        raise InputError(path, "", "an image that decodes", "damaged data")
    return pixels.astype(np.uint8, copy=False)


def _probe(path: Path, stream: BinaryIO) -> ImageInfo:
    head = stream.read(33)
    if not head:
        raise InputError(path, "", "an image", "an empty file")
    if head.startswith(_PNG_SIGNATURE):
        info = _probe_png(path, stream, head)
    elif head.startswith(_JPEG_START):
        info = _probe_jpeg(path, stream)
    else:
        raise InputError(path, "", "a PNG or JPEG image", f"a file that starts with {head[:4]!r}")
    if not 0 < info.width * info.height <= MAX_PIXELS:
        raise InputError(path, "", f"an image of 1 to {MAX_PIXELS} pixels", f"{info.width}x{info.height}")
    size = stream.seek(0, io.SEEK_END)
    if size > MAX_EXTRA + 8 * info.width * info.height:
        raise InputError(path, "", f"the data of {info.width}x{info.height} pixels", f"{size} bytes")
    return info


def _probe_png(path: Path, stream: BinaryIO, head: bytes) -> ImageInfo:
    if len(head) < 33 or head[12:16] != b"IHDR":
        raise InputError(path, "", "a whole PNG header", f"{len(head)} bytes of one")
    width, height, depth, colour = struct.unpack(">IIBB", head[16:26])
    if depth > 8 or colour not in _PNG_CHANNELS:
        raise InputError(path, "", "8 bits per channel", f"bit depth {depth}, colour type {colour}")
    if _tail(stream, len(_PNG_END)) != _PNG_END:
        raise InputError(path, "", "a whole PNG, ending with its IEND chunk", "a truncated file")
    samples = 1 if colour == 3 else _PNG_CHANNELS[colour]
    raw = height * (1 + (width * depth * samples + 7) // 8)
    if raw > _DEFLATE_RATIO * stream.tell():
        raise InputError(
            path, "", f"a PNG with the data of {width}x{height} pixels", f"{stream.tell()} bytes"
        )
    return ImageInfo(width, height, _PNG_CHANNELS[colour])


def _probe_jpeg(path: Path, stream: BinaryIO) -> ImageInfo:
    if _JPEG_END not in _tail(stream, _JPEG_TAIL_BYTES):
        raise InputError(path, "", "a whole JPEG, ending with its EOI marker", "a truncated file")
    stream.seek(len(_JPEG_START))
    while len(segment := stream.read(4)) == 4:
        marker, length = struct.unpack(">xBH", segment)
        if segment[0] != 0xFF:
            break
        if marker in _JPEG_FRAME_MARKERS:
            frame = stream.read(6)
            if len(frame) < 6:
                break
            depth, height, width, channels = struct.unpack(">BHHB", frame)
            if depth != 8:
                raise InputError(path, "", "8 bits per channel", f"{depth}")
            return ImageInfo(width, height, channels)
        stream.seek(length - 2, 1)
    raise InputError(path, "", "a JPEG with a frame header", "none")


def _tail(stream: BinaryIO, size: int) -> bytes:
    stream.seek(0, 2)
    stream.seek(max(0, stream.tell() - size))
    return stream.read(size)


def quantise(rgb: FloatArray) -> ByteArray:
    """Round colours in [0, 1] to 8 bits, to the nearest level; what lies outside is clamped.

    Truncating (``rgb * 255`` cast to an integer) would darken by half a level on average. Raises `InputError`
    for a non-finite colour, since any level chosen for it would hide a fault of the renderer, and for an
    array that is not floating point.
    """
    if not np.issubdtype(rgb.dtype, np.floating):
        raise InputError("render", "rgb", "a floating-point array in [0, 1]", str(rgb.dtype))
    finite = np.isfinite(rgb)
    if not finite.all():
        found = f"{rgb.size - int(finite.sum())} of {rgb.size} values infinite or not a number"
        raise InputError("render", "rgb", "finite colours", found)
    return np.rint(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8)


def write_png(path: Path, image: ByteArray, kind: str = "") -> bytes:
    """Write an (H, W, 3) 8-bit sRGB image, atomically; return what was written.

    ``kind`` marks it, see `provenance`; "" for frames that metrics are computed from.
    """
    ok, encoded = cv2.imencode(
        ".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 3]
    )
    if not ok:
        raise InputError(path, "", "an image that PNG can hold", f"shape {image.shape}, {image.dtype}")
    content = mark_png(encoded.tobytes(), kind) if kind else encoded.tobytes()
    write_bytes(path, content)
    return content


def read_png(path: Path) -> ByteArray:
    """Read an (H, W, 3) 8-bit sRGB image. Raises `InputError` for a missing or damaged file."""
    image = read_pixels(path, cv2.IMREAD_COLOR)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
