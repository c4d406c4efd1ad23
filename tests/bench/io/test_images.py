"""Images against files made by an independent encoder; frames are rounded to levels and come back as they were."""

from __future__ import annotations

import io
import resource
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from headbench.bench.errors import InputError
from headbench.bench.io.images import (
    MAX_PIXELS,
    MAX_SCANS,
    ImageInfo,
    encode_image,
    probe_image,
    quantise,
    read_bgr,
    read_pixels,
    read_png,
    write_png,
)
from headbench.datasets.images import read_image, read_mask, write_image

from ...memory import memory_below

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
    with pytest.raises(InputError) as caught, memory_below(2**20):
        read(path)
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


NOISE = np.random.default_rng(3).integers(0, 256, (23, 37, 4), np.uint8)
STEPS = NOISE[..., 0] // 64 * 64
RED_TABLE, DARK_TABLE, GREY_TABLE = ([0, 0, 0, *entry] for entry in ((128, 0, 0), (0, 64, 0), (90, 90, 90)))


def picture(mode: str, table: list[int] | None = None) -> Image.Image:
    """Noise in a mode of Pillow; "P" with a number of colours, "Pa" with transparent ones."""
    if table is not None:
        indexed = Image.fromarray((NOISE[..., 0] > 127).astype(np.uint8)).convert("P")
        indexed.putpalette(table + [0] * (768 - len(table)))
        indexed.putdata((NOISE[..., 0] > 127).astype(np.uint8).ravel().tolist())
        return indexed
    if mode == "Pa":
        return Image.fromarray(NOISE).quantize(64)
    if mode[0] == "P":
        return Image.fromarray(NOISE[..., :3]).quantize(int(mode[1:]))
    if mode == "steps":
        return Image.fromarray(STEPS)
    return Image.fromarray(NOISE if mode in ("RGBA", "LA") else NOISE[..., :3]).convert(mode)


def saved(image: Image.Image, format: str = "PNG", **options) -> bytes:
    stream = io.BytesIO()
    image.save(stream, format, **options)
    return stream.getvalue()


STORED = {
    **{
        mode: saved(picture(mode))
        for mode in ("1", "L", "LA", "RGB", "RGBA", "P256", "P16", "P4", "P2", "Pa")
    },
    "L, one level transparent": saved(picture("steps"), transparency=64),
    "1, black transparent": saved(picture("1"), transparency=0),
    "RGB, one colour transparent": saved(picture("RGB"), transparency=tuple(NOISE[0, 0, :3].tolist())),
    "P, opaque table": saved(picture("P16"), transparency=bytes([255] * 16)),
}


@pytest.mark.parametrize("name", STORED)
def test_pixels_are_those_that_another_decoder_shows(tmp_path, name):
    path = tmp_path / "image.png"
    path.write_bytes(STORED[name])
    with Image.open(path) as image:
        rgba = np.array(image.convert("RGBA"))
    assert probe_image(path).has_alpha == (rgba[..., 3] < 255).any()
    assert np.array_equal(read_png(path), rgba[..., :3])
    assert np.array_equal(read_bgr(path)[..., ::-1], rgba[..., :3])
    if probe_image(path).has_alpha:
        assert np.array_equal(read_pixels(path)[..., 3], rgba[..., 3])
        assert np.array_equal(read_mask(path), rgba[..., 3])
        weight = rgba[..., 3:].astype(np.float32) / 255
        assert np.abs(read_image(path, (0, 0, 0)) - weight * rgba[..., :3]).max() <= 0.5 + 1e-4
    else:
        assert np.array_equal(read_image(path, (0, 0, 0)), rgba[..., :3])


ON = NOISE[..., 0] > 127
MASKS = {
    "red table": (saved(picture("P", RED_TABLE)), 255 * ON),
    "dark green table": (saved(picture("P", DARK_TABLE)), 255 * ON),
    "grey table": (saved(picture("P", GREY_TABLE)), 90 * ON),
    "soft grey": (saved(picture("L")), np.array(picture("L"))),
    "soft grey in RGB": (saved(picture("L").convert("RGB")), np.array(picture("L"))),
    "soft red in RGB": (
        saved(Image.fromarray(NOISE[..., :3] * np.array([1, 0, 0], np.uint8))),
        NOISE[..., 0],
    ),
    "one bit": (saved(Image.fromarray(ON)), 255 * ON),
    "grey in opaque RGBA": (saved(picture("L").convert("RGBA")), np.array(picture("L"))),
    "colours in opaque RGBA": (saved(picture("RGB").convert("RGBA")), np.array(picture("RGB")).max(axis=2)),
}


def test_a_comment_is_not_taken_for_the_transparent_level(tmp_path):
    comment = PngImagePlugin.PngInfo()
    comment.add_text("Comment", "a tRNS chunk follows")
    path = tmp_path / "image.png"
    picture("L").save(path, transparency=7, pnginfo=comment)
    level = np.array(picture("L"))
    assert np.array_equal(read_pixels(path)[..., 3], np.where(level == 7, 0, 255))


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_an_opaque_alpha_channel_of_an_image_covers_it(tmp_path, mode):
    """Its own, where no mask is named: brightness is no coverage."""
    (tmp_path / "image.png").write_bytes(saved(picture(mode).convert("RGBA")))
    assert (read_mask(tmp_path / "image.png", own=True) == 255).all()


@pytest.mark.parametrize("name", MASKS)
def test_a_mask_covers_what_a_viewer_shows_as_not_black(tmp_path, name):
    content, expected = MASKS[name]
    (tmp_path / "mask.png").write_bytes(content)
    assert np.array_equal(read_mask(tmp_path / "mask.png"), expected)


@pytest.mark.parametrize("orientation", range(2, 9))
@pytest.mark.parametrize(("mode", "format"), [("RGB", "PNG"), ("L", "PNG"), ("RGB", "JPEG"), ("L", "JPEG")])
def test_pixels_stay_where_they_are_stored(tmp_path, mode, format, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    paths = tmp_path / "plain", tmp_path / "tagged"
    paths[0].write_bytes(saved(picture(mode), format))
    paths[1].write_bytes(saved(picture(mode), format, exif=exif))
    for read in (read_pixels, read_png, read_bgr, read_mask, lambda path: read_image(path, (1, 1, 1))):
        plain, tagged = map(read, paths)
        assert np.array_equal(plain, tagged)
    assert probe_image(paths[1]) == probe_image(paths[0])


BEHIND = {
    "text": b"trailing text",
    "zeros": bytes(5000),
    "markers of scans": b"\xff\xda\xff\xd8" * 1000,
    "another image": STORED["RGB"] + saved(picture("L"), "JPEG") + bytes(100),
}


@pytest.mark.parametrize("behind", BEHIND)
@pytest.mark.parametrize(
    ("format", "options"),
    [("PNG", {}), ("JPEG", {}), ("JPEG", {"progressive": True, "exif": b"Exif\0\0\xff\xd9"})],
)
def test_bytes_behind_an_image_are_ignored(tmp_path, format, options, behind):
    whole = saved(picture("RGB"), format, **options)
    plain, longer, cut = (tmp_path / name for name in ("plain", "longer", "cut"))
    plain.write_bytes(whole)
    longer.write_bytes(whole + BEHIND[behind])
    assert np.array_equal(read_pixels(longer), read_pixels(plain))
    assert probe_image(longer, decode=True) == probe_image(plain)
    if behind in ("text", "zeros"):
        cut.write_bytes(whole[: len(whole) // 2] + BEHIND[behind])
        with pytest.raises(InputError, match="truncated"):
            probe_image(cut)


def test_a_file_of_two_pictures_is_read_as_its_first(tmp_path):
    first, second = picture("RGB"), Image.new("RGB", (37, 23), "red")
    (tmp_path / "first").write_bytes(saved(first, "JPEG"))
    (tmp_path / "both").write_bytes(saved(first, "MPO", save_all=True, append_images=[second]))
    assert np.array_equal(read_png(tmp_path / "both"), read_png(tmp_path / "first"))


OTHERS = {
    "CMYK": (saved(picture("RGB").convert("CMYK"), "JPEG"), "4 components, CMYK or YCCK"),
    "16 bits": (saved(Image.fromarray(NOISE[..., 0].astype(np.uint16) * 257)), "bit depth 16"),
    "animation": (
        saved(picture("RGB"), save_all=True, append_images=[Image.new("RGB", (37, 23))]),
        "an animated PNG",
    ),
    "WebP": (saved(picture("RGBA"), "WEBP"), "WebP data"),
    "TIFF": (saved(picture("RGB"), "TIFF"), "TIFF data"),
    "TIFF of floats": (saved(Image.fromarray(NOISE[..., 0].astype(np.float32)), "TIFF"), "TIFF data"),
    "Lab": (saved(picture("RGB").convert("LAB"), "TIFF"), "TIFF data"),
    "GIF": (saved(picture("P16"), "GIF"), "GIF data"),
    "JPEG 2000": (b"\0\0\0\x0cjP  \r\n\x87\n" + bytes(40), "JPEG 2000 data"),
    "HEIC": (b"\0\0\0\x18ftypheic" + bytes(40), "HEIF, AVIF or video data"),
    "a file of macOS": (b"\0\x05\x16\x07" + bytes(80), "AppleDouble"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_not_converted_is_refused_by_name(tmp_path, name):
    content, found = OTHERS[name]
    path = tmp_path / "image.png"
    path.write_bytes(content)
    for read in (probe_image, read_pixels, read_png, read_mask):
        with pytest.raises(InputError, match=found) as caught:
            read(path)
        assert caught.value.file == str(path)


WRITERS = {
    "frame": ("a.png", lambda path: write_png(path, NOISE[..., :3])),
    "image": ("a.png", lambda path: write_image(path, NOISE)),
    "JPEG": ("a.jpg", lambda path: write_image(path, NOISE[..., :3])),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_reported_with_the_file(tmp_path, name):
    file, write = WRITERS[name]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (700, limits[1]))
    try:
        with pytest.raises(OSError, match=rf"File too large: '{tmp_path / file}'$"):
            write(tmp_path / file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
    write(tmp_path / file)
    assert [path.name for path in tmp_path.iterdir()] == [file]


@pytest.mark.parametrize(
    ("shape", "suffix"), [((4, 4, 5), ".png"), ((0, 4, 3), ".png"), ((4, 4, 3), ".nope")]
)
def test_what_a_format_cannot_hold_is_refused(shape, suffix):
    with pytest.raises(InputError, match=f"a.x: expected an image that the format {suffix} can hold"):
        encode_image(np.zeros(shape, np.uint8), suffix, place="a.x")
