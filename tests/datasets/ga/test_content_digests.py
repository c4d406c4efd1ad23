"""Digests by content, and when the remembered ones are used."""

import hashlib
import json
import os

import pytest

from headbench.bench.io.files import digest
from headbench.datasets.ga import content_digests as module
from headbench.datasets.ga.content_digests import content_digests


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of remembered digests, where also files that were just written are remembered."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "YOUNG_NS", -(10**9))
    return tmp_path / "cache" / "headbench" / "digests"


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    folder.mkdir()
    for name in ("a", "b", "c"):
        (folder / name).write_text(name)
    return folder


@pytest.fixture
def reads(monkeypatch):
    """Names of the files whose bytes were read."""
    names = []
    original = module.digest_file
    monkeypatch.setattr(module, "digest_file", lambda path: names.append(path.name) or original(path))
    return names


def expected(folder):
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def test_only_what_changed_is_read_again(capture, cache, reads):
    for change in (None, None, ("b", "other"), ("c", "C")):
        if change:
            name, text = change
            before = (capture / name).stat()
            (capture / name).write_text(text)
            os.utime(capture / name, ns=(before.st_atime_ns, before.st_mtime_ns))
        else:
            name = "abc" if not cache.exists() else ""
        reads.clear()
        assert content_digests(capture.iterdir(), cached_for=capture) == expected(capture)
        assert "".join(sorted(reads)) == name
    assert sorted(path.name for path in capture.iterdir()) == ["a", "b", "c"]


def test_without_memory_every_byte_is_read(capture, cache, reads):
    content_digests(capture.iterdir(), cached_for=capture)
    for path in cache.iterdir():  # what is remembered is wrong, as it cannot be but on purpose
        entries = dict.fromkeys(json.loads(path.read_text())["entries"], "0" * 64)
        path.write_text(json.dumps({"digest": digest(entries), "entries": entries}))
    assert content_digests(capture.iterdir(), cached_for=capture) != expected(capture)
    reads.clear()
    assert content_digests(capture.iterdir()) == expected(capture)
    assert sorted(reads) == ["a", "b", "c"]


def test_a_file_that_just_changed_is_not_remembered(capture, cache, monkeypatch):
    monkeypatch.setattr(module, "YOUNG_NS", 60 * 10**9)
    content_digests(capture.iterdir(), cached_for=capture)
    assert all(json.loads(path.read_text())["entries"] == {} for path in cache.iterdir())
