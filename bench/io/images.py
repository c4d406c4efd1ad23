"""Decoding and encoding of images: Pillow reads headers, OpenCV pixels.

Pixels are read as stored, since intrinsics refer to stored pixels: orientation tags, colour profiles
and gamma are ignored. Palettes are applied. Alpha channels are those of PNG: RGBA, grey with alpha, or a
tRNS chunk.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from ..contracts import ByteArray, FloatArray
from ..errors import InputError
from .files import open_regular, reading, write_bytes
from .provenance import mark_png

_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by colour type (PNG specification, 11.2.2)
_PNG_TABLE = 3
_PNG_END, _JPEG_END = b"IEND\xaeB`\x82", b"\xff\xd9"
_TAIL_BYTES = 64  # some encoders add padding after the end marker
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)  # does not occur in the data of a scan
_FOREIGN = {
    rb"....ftyp": "HEIF, AVIF or video",
    rb"\x00\x00\x00\x0cJXL|\xff\x0a": "JPEG XL",
    rb"v/1\x01": "OpenEXR",
    rb"#\?RADIANCE": "Radiance HDR",
    rb"\x00\x05\x16\x07": "AppleDouble (a ._ file of macOS)",
    rb"version https://git-lfs": "Git LFS pointer",
}
"""Other files that Pillow does not know, by their first bytes."""


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
    of the image are ignored. Raises `InputError` for a missing, empty, foreign or truncated file, more than 8 bits per
    channel, an animation and a CMYK JPEG.
    """
    with open_regular(path, "an image file") as stream:
        info = _header(path, stream)
        if decode:
            _decode(path, stream, info)
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
    foreign = [name for start, name in _FOREIGN.items() if re.match(start, head, re.DOTALL)]
    if foreign:
        raise InputError(path, "", expected, f"{foreign[0]} data", remedy)
    stream.seek(0)
    with reading(path, expected):
        try:
            image = Image.open(stream)
        except UnidentifiedImageError as error:
            raise InputError(path, "", expected, f"a file that starts with {head[:4]!r}", remedy) from error
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
