"""A training image that was exchanged without a trace is found by all that judge, whatever is remembered of it."""

from __future__ import annotations

import os
import struct
import zlib

import pytest

from headbench.bench.engine.captures import open_clips
from headbench.bench.engine.config import RunConfig
from headbench.datasets.ga import content_digests
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.lint.command import lint
from headbench.datasets.lint.settings import LintSettings

from ..tiny_capture import FRONTAL, SERIALS


def padded(png: bytes, size: int) -> bytes:
    """The same picture in a file of another size, by a private chunk."""
    content = b"paDd" + bytes(size - len(png) - 12)
    chunk = struct.pack(">I", len(content) - 4) + content + struct.pack(">I", zlib.crc32(content))
    return png[:-12] + chunk + png[-12:]


@pytest.fixture
def exchanged(capture, tmp_path, monkeypatch):
    """Read once and remembered; then a training image gets the content of a test image. The clock is deceived, too."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(content_digests, "YOUNG_NS", -(10**9))
    stamp_of = content_digests.Stamp.of
    monkeypatch.setattr(content_digests.Stamp, "of", lambda path: stamp_of(path)._replace(changed=0))
    train = capture.writer.image_path("EMO-1-shout+laugh", 1, SERIALS[2])
    test = capture.writer.image_path("FREE", 1, FRONTAL)
    size = max(len(path.read_bytes()) for path in (train, test)) + 20
    for path in (train, test):
        path.write_bytes(padded(path.read_bytes(), size))
    before, status = read_capture(capture.union).source_fingerprint, train.stat()
    train.write_bytes(test.read_bytes())
    os.utime(train, ns=(status.st_atime_ns, status.st_mtime_ns))
    return capture, before


def test_the_leak_check_reads_the_bytes(exchanged):
    capture, _ = exchanged
    clip = read_capture(capture.union, leaks="record")
    assert "same content" in clip.steps[0].parameters["leaks"][0]


def test_what_verify_opens_has_another_fingerprint(exchanged):
    capture, before = exchanged
    config = RunConfig(str(capture.union), "out", reader="ga", reader_settings={"leaks": "record"})
    remembered, fresh = (open_clips(config, use_cache=choice)[0] for choice in (True, False))
    assert remembered.source_fingerprint == before
    assert fresh.source_fingerprint != before


def test_lint_reads_the_bytes(exchanged):
    capture, _ = exchanged
    assert "HB201" in lint(LintSettings(str(capture.union))).text
