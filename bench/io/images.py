"""Decoding and encoding of images. Files are checked against limits before pixels are decoded.

Pixels are read as stored, since intrinsics refer to stored pixels: orientation tags, colour profiles
and gamma are ignored. Palettes are applied. Alpha channels are those of PNG: RGBA, grey with alpha, or a
tRNS chunk.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from ..contracts import ByteArray, FloatArray
from ..errors import InputError
from .files import open_regular, write_bytes
from .provenance import mark_png

MAX_PIXELS = 2**25
"""Maximum size of an image, as in 8192 x 4096: a small header can declare any size, and decoding allocates its memory."""
MAX_EXTRA = 2**26
"""Maximum bytes of a file beyond 8 per pixel, for colour profiles and previews. Sparse files take no space on disk."""
MAX_SCANS = 100
"""Maximum scans of a progressive JPEG, which has about ten: a few bytes can cause a pass over all pixels."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by colour type (PNG specification, 11.2.2)
_PNG_TABLE = 3
_PNG_CHUNKS = 2**16  # a PNG of `MAX_PIXELS` in chunks of 8 kB has a quarter of that
_DEFLATE_RATIO = 1040  # the maximum of deflate is 1032 bytes out per byte in
_JPEG_START, _JPEG_END, _JPEG_SCAN = b"\xff\xd8", b"\xff\xd9", b"\xff\xda"
# Start-of-frame markers: SOF0..SOF15 except DHT (C4), JPG (C8) and DAC (CC), which share the range.
_JPEG_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_TAIL_BYTES = 64  # some encoders add padding after the end marker
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)  # does not occur in the data of a scan
_FOREIGN = {
    rb"RIFF....WEBP": "WebP",
    rb"II\*\x00|MM\x00\*|II\+\x00|MM\x00\+": "TIFF",
    rb"GIF8": "GIF",
    rb"BM": "BMP",
    rb"....ftyp": "HEIF, AVIF or video",
    rb"\x00\x00\x00\x0cjP|\xff\x4f\xff\x51": "JPEG 2000",
    rb"\x00\x00\x00\x0cJXL|\xff\x0a": "JPEG XL",
    rb"v/1\x01": "OpenEXR",
    rb"#\?RADIANCE": "Radiance HDR",
    rb"8BPS": "Photoshop",
    rb"P[1-7fF]\s": "PNM",
    rb"\x00\x05\x16\x07": "AppleDouble (a ._ file of macOS)",
    rb"version https://git-lfs": "Git LFS pointer",
}
"""Other image formats, by the first bytes of their files."""


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

    @property
    def has_alpha(self) -> bool:
        """Whether the image has transparency: an alpha channel, or PNG's chunk tRNS."""
        return self.channels in (2, 4)


def probe_image(path: Path, *, decode: bool = False) -> ImageInfo:
    """Read the size of a PNG or JPEG and check that the file is complete.

    Needs only a few small reads; ``decode`` also decodes the pixels, which detects damage in the middle. Bytes after the end
    of the image are ignored. Raises `InputError` for a missing, empty, foreign or truncated file, more than 8 bits per
    channel, an animation, a CMYK JPEG, more than `MAX_PIXELS`, and more pixels than the file can contain.
    """
    with open_regular(path, "an image file") as stream:
        info, end = _probe(path, stream)
        if decode:
            _decode(path, stream, info, end)
    return info


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

    Raises
    ------
    InputError
        The file is refused by `probe_image`, has another size, or is too damaged to be decoded.
    """
    with open_regular(path, "an image file") as stream:
        info, end = _probe(path, stream)
        if size is not None and (info.width, info.height) != size:
            raise InputError(path, "", f"{size[0]}x{size[1]} pixels", f"{info.width}x{info.height}")
        return _decode(path, stream, info, end)


def _decode(path: Path, stream: BinaryIO, info: ImageInfo, end: int) -> ByteArray:
    """Decode the first ``end`` bytes, which `_probe` has accepted."""
    stream.seek(0)
    content = stream.read()[:end]
    if info.format == "JPEG" and content.count(_JPEG_SCAN) > MAX_SCANS:
        raise InputError(path, "", f"a JPEG of at most {MAX_SCANS} scans", f"{content.count(_JPEG_SCAN)}")
    try:
        # Only with this flag does OpenCV ignore orientation tags.
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(path, "", "an image that decodes", f"damaged data ({error.err})"[:200]) from error
    if pixels is None or pixels.dtype != np.uint8 or pixels.shape[:2] != (info.height, info.width):
        raise InputError(path, "", "an image that decodes", "damaged data")
    levels = pixels.astype(np.uint8, copy=False)
    if info.channels == 2 and levels.ndim == 2:
        return _grey_with_alpha(levels, content)
    if info.channels == 3 and levels.shape[2:] == (4,):
        return np.ascontiguousarray(levels[..., :3])  # a palette of opaque colours
    return levels


def _grey_with_alpha(grey: ByteArray, content: bytes) -> ByteArray:
    """Apply the chunk tRNS of a grey PNG (one transparent level), which OpenCV ignores."""
    depth, stream = content[24], io.BytesIO(content)
    next(name for name, _ in _chunks(stream) if name == b"tRNS")
    level = int.from_bytes(stream.read(2), "big") % 2**depth * 255 // (2**depth - 1)
    return np.dstack([grey, grey, grey, np.where(grey == level, 0, 255)]).astype(np.uint8)


def _probe(path: Path, stream: BinaryIO) -> tuple[ImageInfo, int]:
    """The header, and the position where the image ends."""
    head = stream.read(33)
    if not head:
        raise InputError(path, "", "an image", "an empty file")
    if head.startswith(_PNG_SIGNATURE):
        info = _probe_png(path, stream, head)
    elif head.startswith(_JPEG_START):
        info = _probe_jpeg(path, stream)
    else:
        names = (name for start, name in _FOREIGN.items() if re.match(start, head, re.DOTALL))
        found = next((f"{name} data" for name in names), f"a file that starts with {head[:4]!r}")
        raise InputError(path, "", "a PNG or JPEG image", found, "Convert it, for example to PNG.")
    if not 0 < info.width * info.height <= MAX_PIXELS:
        raise InputError(path, "", f"an image of 1 to {MAX_PIXELS} pixels", f"{info.width}x{info.height}")
    size = stream.seek(0, io.SEEK_END)
    if size > MAX_EXTRA + 8 * info.width * info.height:
        raise InputError(path, "", f"the data of {info.width}x{info.height} pixels", f"{size} bytes")
    return info, (_end_of_png if info.format == "PNG" else _end_of_jpeg)(path, stream, size)


def _probe_png(path: Path, stream: BinaryIO, head: bytes) -> ImageInfo:
    if len(head) < 33 or head[12:16] != b"IHDR":
        raise InputError(path, "", "a whole PNG header", f"{len(head)} bytes of one")
    width, height, depth, colour = struct.unpack(">IIBB", head[16:26])
    if depth > 8 or colour not in _PNG_CHANNELS:
        raise InputError(path, "", "8 bits per channel", f"bit depth {depth}, colour type {colour}")
    channels = _PNG_CHANNELS[colour]
    samples = 1 if colour == _PNG_TABLE else channels
    raw = height * (1 + (width * depth * samples + 7) // 8)
    size = stream.seek(0, io.SEEK_END)
    if raw > _DEFLATE_RATIO * size:
        raise InputError(path, "", f"a PNG with the data of {width}x{height} pixels", f"{size} bytes")
    for name, length in _chunks(stream):
        if name == b"IDAT":
            break
        if name == b"acTL" and int.from_bytes(stream.read(4), "big") > 1:
            raise InputError(path, "", "a single image", "an animated PNG", "Export its frames one by one.")
        if name == b"tRNS" and channels in (1, 3):
            alpha = stream.read(min(length, 256))
            channels += colour != _PNG_TABLE or alpha != b"\xff" * len(alpha)
    return ImageInfo(width, height, channels, "PNG", colour == _PNG_TABLE)


def _chunks(stream: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """Name and length of each chunk of a PNG, with the stream at its data, up to the first invalid chunk."""
    place = len(_PNG_SIGNATURE)
    for _ in range(_PNG_CHUNKS):
        stream.seek(place)
        start = stream.read(8)
        length, name = int.from_bytes(start[:4], "big"), start[4:]
        if len(start) < 8 or not name.isalpha():
            return
        yield name, length
        place += 12 + length


def _end_of_png(path: Path, stream: BinaryIO, size: int) -> int:
    if _tail(stream, len(_PNG_END)) == _PNG_END:
        return size
    for name, _ in _chunks(stream):
        if name == b"IEND" and len(stream.read(4)) == 4:
            return stream.tell()
    raise InputError(path, "", "a whole PNG, ending with its IEND chunk", "a truncated file")


def _probe_jpeg(path: Path, stream: BinaryIO) -> ImageInfo:
    stream.seek(len(_JPEG_START))
    while len(segment := stream.read(4)) == 4:
        marker, length = struct.unpack(">xBH", segment)
        if segment[0] != 0xFF:
            break
        if marker == 0xFF:  # a marker may have fill bytes before it
            stream.seek(-3, 1)
            continue
        if marker in _JPEG_FRAME_MARKERS:
            frame = stream.read(6)
            if len(frame) < 6:
                break
            depth, height, width, channels = struct.unpack(">BHHB", frame)
            if depth != 8:
                raise InputError(path, "", "8 bits per channel", f"{depth}")
            if channels not in (1, 3):
                found = f"{channels} components" + (", CMYK or YCCK" if channels == 4 else "")
                remedy = "Convert it to RGB by its colour profile, for example to PNG."
                raise InputError(path, "", "a JPEG of grey or RGB", found, remedy)
            return ImageInfo(width, height, channels, "JPEG")
        stream.seek(length - 2, 1)
    raise InputError(path, "", "a JPEG with a frame header", "none")


def _end_of_jpeg(path: Path, stream: BinaryIO, size: int) -> int:
    if _JPEG_END in _tail(stream, _JPEG_TAIL_BYTES):
        return size
    stream.seek(0)  # cameras and phones append previews and videos
    content = stream.read()
    place = len(_JPEG_START)
    while match := _JPEG_MARKER.search(content, place):
        place = match.end()
        if match.group() == _JPEG_END:
            return place
        place += int.from_bytes(content[place : place + 2], "big")
    raise InputError(path, "", "a whole JPEG, ending with its EOI marker", "a truncated file")


def _tail(stream: BinaryIO, size: int) -> bytes:
    stream.seek(0, 2)
    stream.seek(max(0, stream.tell() - size))
    return stream.read(size)


def quantise(rgb: FloatArray) -> ByteArray:
    """Round colours in [0, 1] to the nearest 8-bit level; values outside are clamped.

    Truncating (``rgb * 255`` cast to an integer) would darken by half a level on average. Raises `InputError`
    for a non-finite colour, since any level would hide a bug of the renderer, and for an array that is not
    floating point.
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

    ``options`` are OpenCV's, ``place`` is named in errors. Raises `InputError` if the format cannot represent
    the image.
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
    """Read an (H, W, 3) 8-bit image in BGR order, without its alpha. Raises `InputError` as `read_pixels` does."""
    pixels = read_pixels(path, size)
    if pixels.ndim == 3 and pixels.shape[2] == 3:
        return pixels
    order = cv2.COLOR_GRAY2BGR if pixels.ndim == 2 else cv2.COLOR_BGRA2BGR
    return cv2.cvtColor(pixels, order).astype(np.uint8, copy=False)


def read_png(path: Path) -> ByteArray:
    """Read an (H, W, 3) 8-bit sRGB image, without its alpha. Raises `InputError` as `read_pixels` does."""
    pixels = read_pixels(path)
    orders = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    order = orders[1 if pixels.ndim == 2 else pixels.shape[2]]
    return np.asarray(cv2.cvtColor(pixels, order), dtype=np.uint8)
