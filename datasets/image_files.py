"""Find broken image files without decoding them: header, size, and the end marker that truncation cuts off."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import cv2

from ..bench.errors import InputError

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by colour type (PNG specification, 11.2.2)
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
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
    `InputError` for a missing, empty, foreign or truncated file, and for more than 8 bits per channel.
    """
    try:
        with path.open("rb") as stream:
            info = _probe(path, stream)
    except OSError as error:
        raise InputError(path, "", "an image file", _reason(error)) from error
    if decode and cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is None:
        raise InputError(path, "", "an image that decodes", "damaged data")
    return info


def _reason(error: OSError) -> str:
    return "no such file" if isinstance(error, FileNotFoundError) else f"a file that cannot be read ({error})"


def _probe(path: Path, stream: BinaryIO) -> ImageInfo:
    head = stream.read(33)
    if not head:
        raise InputError(path, "", "an image", "an empty file")
    if head.startswith(_PNG_SIGNATURE):
        return _probe_png(path, stream, head)
    if head.startswith(_JPEG_START):
        return _probe_jpeg(path, stream)
    raise InputError(path, "", "a PNG or JPEG image", f"a file that starts with {head[:4]!r}")


def _probe_png(path: Path, stream: BinaryIO, head: bytes) -> ImageInfo:
    if len(head) < 33 or head[12:16] != b"IHDR":
        raise InputError(path, "", "a whole PNG header", f"{len(head)} bytes of one")
    width, height, depth, colour = struct.unpack(">IIBB", head[16:26])
    if depth > 8 or colour not in _PNG_CHANNELS:
        raise InputError(path, "", "8 bits per channel", f"bit depth {depth}, colour type {colour}")
    if _tail(stream, len(_PNG_END)) != _PNG_END:
        raise InputError(path, "", "a whole PNG, ending with its IEND chunk", "a truncated file")
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
