"""Images against files made by an independent encoder; frames are rounded to levels and come back as they were."""

from __future__ import annotations

import io
import resource
from contextlib import nullcontext
from importlib.metadata import version
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from headbench.bench.errors import InputError
from headbench.bench.io.images import (
    ImageInfo,
    probe_image,
    quantise,
    read_bgr,
    read_pixels,
    read_png,
    write_browser_video,
    write_png,
)
from headbench.bench.io.provenance import COMPOSITE, RENDER, SYNTHETIC, note
from headbench.datasets.images import read_image, read_mask, write_image
from headbench.methods.avatars.export import STANDARD
from headbench.methods.shared.tensor_files import read_ply, write_ply

TERMS = "http://cv.iptc.org/newscodes/digitalsourcetype/"


def source_of(path):
    """Tool and digital source type, as an XMP reader finds them; None without a packet."""
    with Image.open(path) as image:
        packet = image.info.get("XML:com.adobe.xmp")
    if packet is None:
        return None
    root = ElementTree.fromstring(packet.encode())
    (tool,) = root.iter("{http://ns.adobe.com/xap/1.0/}CreatorTool")
    (source,) = root.iter("{http://iptc.org/std/Iptc4xmpExt/2008-02-29/}DigitalSourceType")
    return tool.text, source.text


@pytest.fixture
def pixels():
    return np.random.default_rng(0).integers(0, 256, (12, 9, 3), dtype=np.uint8)


@pytest.mark.parametrize("kind", [RENDER, COMPOSITE, SYNTHETIC])
def test_marks_stand_beside_unchanged_pixels(tmp_path, pixels, kind):
    write_png(tmp_path / "a.png", pixels, kind)
    assert source_of(tmp_path / "a.png") == (f"headbench {version('headbench')}", TERMS + kind)
    assert np.array_equal(read_png(tmp_path / "a.png"), pixels)
    with Image.open(tmp_path / "a.png") as image:
        assert np.array_equal(np.asarray(image), pixels)
        image.load()
    write_png(tmp_path / "plain.png", pixels)
    assert source_of(tmp_path / "plain.png") is None
    plain, marked = (tmp_path / "plain.png").read_bytes(), (tmp_path / "a.png").read_bytes()
    assert marked[:33] + marked[-len(plain) + 33 :] == plain


@pytest.mark.parametrize("name", ["a.webm", "a.mp4"])
def test_videos_carry_a_tag(tmp_path, name):
    av = pytest.importorskip("av")
    write_browser_video(tmp_path / name, np.zeros((3, 16, 16, 3), np.uint8), 25.0, RENDER)
    with av.open(str(tmp_path / name)) as container:
        tags = {name.lower(): text for name, text in container.metadata.items()}
    assert tags["comment"] == note(RENDER)
    with pytest.raises(InputError, match="17x16") if name == "a.mp4" else nullcontext():
        write_browser_video(tmp_path / name, np.zeros((3, 16, 17, 3), np.uint8), 25.0, RENDER)


def test_a_ply_says_it_behind_its_properties(tmp_path):
    table = np.random.default_rng(0).normal(size=(4, len(STANDARD))).astype(np.float32)
    write_ply(tmp_path / "a.ply", STANDARD, table, note(RENDER))
    lines = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert lines[-1] == f"comment {note(RENDER)}"
    assert lines[2] == "element vertex 4"
    assert np.array_equal(read_ply(tmp_path / "a.ply", STANDARD), table)


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


HEADERS = [
    (mode, "PNG", count, {}) for mode, count in {"L": 1, "RGB": 3, "RGBA": 4, "LA": 2, "P16": 3}.items()
]
HEADERS += [
    (mode, "JPEG", count, options)
    for mode, count in {"L": 1, "RGB": 3}.items()
    for options in ({}, {"progressive": True}, {"exif": b"Exif\0\0" + bytes(200)})
]


@pytest.mark.parametrize(("mode", "format", "channels", "options"), HEADERS)
def test_a_header_is_read(tmp_path, mode, format, channels, options):
    path = tmp_path / "image"
    path.write_bytes(saved(picture(mode), format, **options))
    assert probe_image(path, decode=True) == ImageInfo(37, 23, channels)
    assert read_pixels(path, size=(37, 23)).shape[:2] == (23, 37)
    with pytest.raises(InputError, match="38x23 pixels, found 37x23"):
        read_pixels(path, size=(38, 23))


@settings(max_examples=60, deadline=None)
@given(data=st.data(), format=st.sampled_from(["PNG", "JPEG"]))
def test_every_truncation_is_found(tmp_path_factory, data, format):
    whole = saved(picture("RGB"), format)
    path = tmp_path_factory.mktemp("truncated") / "image"
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with pytest.raises(InputError):
        probe_image(path)


def test_every_level_survives_the_round_trip(tmp_path):
    image = np.arange(256, dtype=np.uint8).reshape(16, 16, 1) * np.array([1, 3, 7], np.uint8)
    write_png(tmp_path / "a.png", image)
    assert np.array_equal(read_png(tmp_path / "a.png"), image)
    assert np.array_equal(quantise(image.astype(np.float32) / 255), image)


def test_rounding_goes_to_the_nearest_level_and_clamps():
    rgb = np.array([[[-0.5, 0.49 / 255, 0.51 / 255], [254.4 / 255, 254.6 / 255, 2.0]]])
    assert quantise(rgb).tolist() == [[[0, 0, 1], [254, 255, 255]]]


def test_what_is_no_colour_is_refused():
    for rgb, match in (
        ([[[np.nan, np.inf, 0.0]]], "2 of 3"),
        (np.zeros((1, 1, 3), np.uint8), "floating-point"),
    ):
        with pytest.raises(InputError, match=match):
            quantise(np.asarray(rgb))


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


@pytest.mark.parametrize("name", MASKS)
def test_a_mask_covers_what_a_viewer_shows_as_not_black(tmp_path, name):
    content, expected = MASKS[name]
    (tmp_path / "mask.png").write_bytes(content)
    assert np.array_equal(read_mask(tmp_path / "mask.png"), expected)
    if "opaque" in name:  # its own, where no mask is named: brightness is no coverage
        assert (read_mask(tmp_path / "mask.png", own=True) == 255).all()


@pytest.mark.parametrize("orientation", [3, 6, 7])
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


OTHERS = {
    "CMYK": (saved(picture("RGB").convert("CMYK"), "JPEG"), "4 components, CMYK or YCCK"),
    "16 bits": (saved(Image.fromarray(NOISE[..., 0].astype(np.uint16) * 257)), "bit depth 16"),
    "animation": (
        saved(picture("RGB"), save_all=True, append_images=[Image.new("RGB", (37, 23))]),
        "an animated PNG",
    ),
    "WebP": (saved(picture("RGBA"), "WEBP"), "WEBP data"),
    "HEIC": (b"\0\0\0\x18ftypheic" + bytes(40), "ftypheic"),
    "text": (b"no image", "a file that starts with b'no image'"),
    "a missing file": (None, "no such file"),
    "an empty file": (b"", "an empty file"),
    "half a PNG header": (b"\x89PNG\r\n\x1a\n truncated", "expected"),
    "half a JPEG header": (b"\xff\xd8\xff\xc0\x00\x11\x08\xff\xd9", "expected"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_not_converted_is_refused_by_name(tmp_path, name):
    content, found = OTHERS[name]
    path = tmp_path / "image.png"
    if content is not None:
        path.write_bytes(content)
    for read in (probe_image, read_pixels, read_png, read_mask):
        with pytest.raises(InputError, match=found) as caught:
            read(path)
        assert caught.value.file == str(path)


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_a_full_disk_is_reported_with_the_file(tmp_path, name):
    write = write_png if name == "a.png" else write_image
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (700, limits[1]))
    try:
        with pytest.raises(OSError, match=rf"File too large: '{tmp_path / name}'$"):
            write(tmp_path / name, NOISE[..., :3])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
