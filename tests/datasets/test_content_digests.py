"""Digests by content, and when the remembered ones are used."""

from __future__ import annotations

import hashlib
import os

from headbench.datasets import content_digests as module
from headbench.datasets.content_digests import CACHE_FILE, content_digests


def test_digests_are_sha256_and_reread_only_after_a_change(tmp_path, monkeypatch):
    files = [tmp_path / name for name in ("a", "b", "c")]
    for path in files:
        path.write_text(path.name)
    expected = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    reads = []
    original = module.digest_file
    monkeypatch.setattr(module, "digest_file", lambda path: reads.append(path) or original(path))

    assert content_digests(tmp_path, files) == expected
    assert sorted(reads) == files
    reads.clear()
    assert content_digests(tmp_path, files) == expected
    assert reads == []

    files[1].write_text("other")  # another size
    expected[files[1]] = hashlib.sha256(b"other").hexdigest()
    assert content_digests(tmp_path, files) == expected
    assert reads == [files[1]]
    reads.clear()
    stamp = files[2].stat()
    files[2].write_text("C")  # the same size, another time
    os.utime(files[2], ns=(stamp.st_atime_ns, stamp.st_mtime_ns + 1))
    expected[files[2]] = hashlib.sha256(b"C").hexdigest()
    assert content_digests(tmp_path, files) == expected
    assert reads == [files[2]]


def test_damaged_cache_is_made_anew(tmp_path):
    path = tmp_path / "a"
    path.write_text("a")
    for rubbish in ("", "[]", '{"a": [1]}', '{"a": "xyz"}', "\0"):
        (tmp_path / CACHE_FILE).write_text(rubbish)
        assert content_digests(tmp_path, [path]) == {path: hashlib.sha256(b"a").hexdigest()}


def test_folder_that_cannot_be_written_is_no_obstacle(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_text("a")

    def refuse(*_):
        raise PermissionError("read-only file system")

    monkeypatch.setattr(module, "write_json", refuse)
    assert content_digests(tmp_path, [path]) == {path: hashlib.sha256(b"a").hexdigest()}
