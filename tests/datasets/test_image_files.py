"""Headers and end markers against files made by an independent encoder."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from headbench.bench.errors import InputError
from headbench.datasets.image_files import ImageInfo, probe_image

MODES = {"L": 1, "RGB": 3, "RGBA": 4, "LA": 2, "P": 3}


def encode(mode: str, size: tuple[int, int], format: str, **options) -> bytes:
    noise = np.random.default_rng(0).integers(0, 255, size=(size[1], size[0], 3), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(noise).convert("RGB").convert("L" if mode == "LA" else mode).convert(mode).save(
        stream, format, **options
    )
    return stream.getvalue()


@pytest.mark.parametrize("mode", MODES)
def test_png_header(tmp_path, mode):
    path = tmp_path / "image.png"
    path.write_bytes(encode(mode, (17, 31), "PNG"))
    assert probe_image(path, decode=True) == ImageInfo(17, 31, MODES[mode])


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"exif": b"Exif\0\0" + bytes(200)}])
@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_jpeg_header(tmp_path, mode, options):
    path = tmp_path / "image.jpg"
    path.write_bytes(encode(mode, (17, 31), "JPEG", **options))
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


def test_jpeg_that_ends_within_its_frame_header(tmp_path):
    path = tmp_path / "image.jpg"
    path.write_bytes(b"\xff\xd8" + b"\xff\xc0\x00\x11" + b"\x08\xff\xd9")
    with pytest.raises(InputError, match="frame header"):
        probe_image(path)


def test_missing_and_foreign_files(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        probe_image(tmp_path / "none.png")
    with pytest.raises(InputError, match="cannot be read"):
        probe_image(tmp_path)
    path = tmp_path / "image.bmp"
    path.write_bytes(encode("RGB", (4, 4), "BMP"))
    with pytest.raises(InputError, match="PNG or JPEG"):
        probe_image(path)
