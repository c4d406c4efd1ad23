"""Marks of provenance, read by other libraries; pixels stay as they are, and frames that are measured have none."""

from contextlib import nullcontext
from importlib.metadata import version
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from headbench.bench.errors import InputError
from headbench.bench.io.images import read_png, write_png
from headbench.bench.io.provenance import COMPOSITE, RENDER, SYNTHETIC, note
from headbench.bench.io.video import write_browser_video
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
