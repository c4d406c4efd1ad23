"""Truncation of mp4 files, found in their boxes."""

import struct

import pytest

from headbench.bench.errors import InputError
from headbench.datasets.nersemble.sequence import check_boxes


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


def large_box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4sQ", 1, kind, 16 + len(content)) + content


def open_ended_box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 0, kind) + content


FTYP, MOOV, MDAT = box(b"ftyp", b"isom"), box(b"moov", bytes(40)), box(b"mdat", bytes(100))


@pytest.mark.parametrize(
    "content",
    [
        FTYP + MDAT + MOOV,
        FTYP + MOOV + large_box(b"mdat", bytes(9)),
        FTYP + MOOV + open_ended_box(b"mdat", b"x"),
    ],
)
def test_whole_files_pass(content, tmp_path):
    path = tmp_path / "video.mp4"
    path.write_bytes(content)
    check_boxes(path)


@pytest.mark.parametrize("order", [FTYP + MDAT + MOOV, FTYP + MOOV + MDAT])
def test_every_truncation_is_found(order, tmp_path):
    path = tmp_path / "video.mp4"
    for length in range(len(order)):
        path.write_bytes(order[:length])
        with pytest.raises(InputError):
            check_boxes(path)


@pytest.mark.parametrize(
    "content", [b"\xff\xd8\xff\xe0 a JPEG of some kind", box(b"\x00\x01\x02\x03", b""), b"<html>"]
)
def test_other_files_are_refused(content, tmp_path):
    path = tmp_path / "video.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError) as error:
        check_boxes(path)
    assert error.value.file == str(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        check_boxes(tmp_path / "video.mp4")


def test_a_real_video_and_its_truncations(pristine_videos, tmp_path):
    video = next(pristine_videos.root.rglob("cam_*.mp4"))
    check_boxes(video)
    content = video.read_bytes()
    path = tmp_path / "video.mp4"
    for fraction in (0.1, 0.5, 0.9, 0.999):
        path.write_bytes(content[: int(fraction * len(content))])
        with pytest.raises(InputError):
            check_boxes(path)
