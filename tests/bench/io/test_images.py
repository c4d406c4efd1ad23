"""Images against files made by an independent encoder; frames are rounded to levels and come back as they were."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from headbench.bench.errors import InputError
from headbench.bench.io.images import (
    MAX_PIXELS,
    MAX_SCANS,
    ImageInfo,
    probe_image,
    quantise,
    read_pixels,
    read_png,
    write_png,
)
from headbench.datasets.images import read_image, read_mask

MODES = {"L": 1, "RGB": 3, "RGBA": 4, "LA": 2, "P": 3}


def encode(mode: str, size: tuple[int, int], format: str, **options) -> bytes:
    noise = np.random.default_rng(0).integers(0, 255, size=(size[1], size[0], 3), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(noise).convert("RGB").convert("L" if mode == "LA" else mode).convert(mode).save(
        stream, format, **options
    )
    return stream.getvalue()


JPEG_OPTIONS = ({}, {"progressive": True}, {"exif": b"Exif\0\0" + bytes(200)})


@pytest.mark.parametrize(
    ("mode", "format", "options"),
    [(mode, "PNG", {}) for mode in MODES]
    + [(mode, "JPEG", options) for mode in ("L", "RGB") for options in JPEG_OPTIONS],
)
def test_a_header_is_read(tmp_path, mode, format, options):
    path = tmp_path / "image"
    path.write_bytes(encode(mode, (17, 31), format, **options))
    assert probe_image(path, decode=True) == ImageInfo(17, 31, MODES[mode])


@settings(max_examples=60, deadline=None)
@given(data=st.data(), format=st.sampled_from(["PNG", "JPEG"]))
def test_every_truncation_is_found(tmp_path_factory, data, format):
    whole = encode("RGB", (24, 16), format)
    length = data.draw(st.integers(0, len(whole) - 1))
    path = tmp_path_factory.mktemp("truncated") / "image"
    path.write_bytes(whole[:length])
    with pytest.raises(InputError):
        probe_image(path)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (None, "no such file"),
        (b"", "an empty file"),
        (encode("RGB", (4, 4), "BMP"), "PNG or JPEG"),
        (b"\x89PNG\r\n\x1a\n truncated", "a whole PNG"),
        (b"\xff\xd8\xff\xc0\x00\x11\x08\xff\xd9", "frame header"),
    ],
)
def test_a_missing_damaged_or_foreign_file_is_refused(tmp_path, content, match):
    path = tmp_path / "image"
    if content is not None:
        path.write_bytes(content)
    for read in (probe_image, read_png):
        with pytest.raises(InputError, match=match):
            read(path)
        with pytest.raises(InputError, match="a folder"):
            read(tmp_path)


def declared(width: int, height: int, depth: int = 8, colour: int = 2, data: bytes = b"") -> bytes:
    """A PNG whose header declares a size, and whose data may be another's."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
        )

    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def jpeg(width: int, height: int, scans: int = 1) -> bytes:
    whole = bytearray(encode("RGB", (16, 16), "JPEG", progressive=True))
    place = whole.index(b"\xff\xc2") + 5
    whole[place : place + 4] = struct.pack(">HH", height, width)
    scan = whole[whole.index(b"\xff\xda") : whole.index(b"\xff\xda") + 40]
    return bytes(whole[:-2]) + scan * scans + b"\xff\xd9"


BOMBS = {
    "a PNG of 20,000 squared": declared(20_000, 20_000),
    "a PNG of 70,000 squared": declared(70_000, 70_000),
    "a PNG of 2^31 columns": declared(2**31, 1),
    "a PNG without pixels": declared(0, 5),
    "a PNG of fewer data than pixels": declared(5000, 5000, data=bytes(1000)),
    "a PNG of 16 bits": declared(4, 4, depth=16, data=bytes(4 * 25)),
    "a PNG with damage inside": declared(40, 40, data=b"\x09" * 40 * 121),
    "a PNG with a hole": declared(4, 4, data=bytes(4 * 13)),
    "a JPEG of 65,000 squared": jpeg(65_000, 65_000),
    "a JPEG of many scans": jpeg(16, 16, MAX_SCANS),
    "a JPEG without pixels": jpeg(0, 16),
}


@pytest.mark.parametrize("read", [read_pixels, read_png, read_mask, lambda path: read_image(path, (1, 1, 1))])
@pytest.mark.parametrize("name", BOMBS)
def test_a_header_that_lies_costs_nothing(tmp_path, name, read, capfd):
    path = tmp_path / "image"
    path.write_bytes(BOMBS[name])
    if name == "a PNG with a hole":
        with path.open("r+b") as stream:
            stream.seek(2**40)
            stream.write(BOMBS[name][-12:])
    tracemalloc.start()
    with pytest.raises(InputError) as caught:
        read(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20
    assert caught.value.file == str(path)


def test_images_of_any_kind_and_of_the_largest_size_are_read(tmp_path):
    path = tmp_path / "image.png"
    side = int(MAX_PIXELS**0.5)
    Image.new("1", (side, MAX_PIXELS // side)).save(path)
    assert probe_image(path).width == side
    for mode in MODES:
        path.write_bytes(encode(mode, (17, 31), "PNG"))
        assert read_pixels(path, size=(17, 31)).shape[:2] == (31, 17)
    with pytest.raises(InputError, match="18x31 pixels, found 17x31"):
        read_pixels(path, size=(18, 31))


def test_every_level_survives_the_round_trip(tmp_path):
    image = np.arange(256, dtype=np.uint8).reshape(16, 16, 1) * np.array([1, 3, 7], np.uint8)
    write_png(tmp_path / "a.png", image)
    assert np.array_equal(read_png(tmp_path / "a.png"), image)
    assert np.array_equal(quantise(image.astype(np.float32) / 255), image)


def test_rounding_goes_to_the_nearest_level_and_clamps():
    rgb = np.array([[[-0.5, 0.49 / 255, 0.51 / 255], [254.4 / 255, 254.6 / 255, 2.0]]])
    assert quantise(rgb).tolist() == [[[0, 0, 1], [254, 255, 255]]]


@pytest.mark.parametrize(
    ("rgb", "match"),
    [([[[np.nan, np.inf, 0.0]]], "2 of 3"), (np.zeros((1, 1, 3), np.uint8), "floating-point")],
)
def test_what_is_no_colour_is_refused(rgb, match):
    with pytest.raises(InputError, match=match):
        quantise(np.asarray(rgb))
