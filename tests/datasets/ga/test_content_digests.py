"""Digests by content, and when the remembered ones are used."""

import hashlib
import json
import os

import numpy as np
import pytest

from headbench.bench.io.files import digest
from headbench.datasets.ga import validate as module
from headbench.datasets.ga.layout import Declaration
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.validate import content_digests


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of remembered digests, where also files that were just written are remembered."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "YOUNG_NS", -(10**9))
    return tmp_path / "cache" / "headbench" / "digests"


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "folder"
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


def test_only_what_changed_is_read_again(folder, cache, reads):
    for change in (None, None, ("b", "other"), ("c", "C")):
        if change:
            name, text = change
            before = (folder / name).stat()
            (folder / name).write_text(text)
            os.utime(folder / name, ns=(before.st_atime_ns, before.st_mtime_ns))
        else:
            name = "abc" if not cache.exists() else ""
        reads.clear()
        assert content_digests(folder.iterdir(), cached_for=folder) == expected(folder)
        assert "".join(sorted(reads)) == name
    assert sorted(path.name for path in folder.iterdir()) == ["a", "b", "c"]


def test_without_memory_every_byte_is_read(folder, cache, reads):
    content_digests(folder.iterdir(), cached_for=folder)
    for path in cache.iterdir():  # what is remembered is wrong, as it cannot be but on purpose
        entries = dict.fromkeys(json.loads(path.read_text())["entries"], "0" * 64)
        path.write_text(json.dumps({"digest": digest(entries), "entries": entries}))
    assert content_digests(folder.iterdir(), cached_for=folder) != expected(folder)
    reads.clear()
    assert content_digests(folder.iterdir()) == expected(folder)
    assert sorted(reads) == ["a", "b", "c"]


def test_a_file_that_just_changed_is_not_remembered(folder, cache, monkeypatch):
    monkeypatch.setattr(module, "YOUNG_NS", 60 * 10**9)
    content_digests(folder.iterdir(), cached_for=folder)
    assert all(json.loads(path.read_text())["entries"] == {} for path in cache.iterdir())


def upside_down(value):
    """A JSON value with the keys of its objects in the opposite order, whole numbers without a point, and no nulls added."""
    if isinstance(value, dict):
        return {key: upside_down(value[key]) for key in reversed(value)}
    if isinstance(value, list):
        return [upside_down(part) for part in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def absolute(frame, folder):
    paths = {key: str((folder / frame[key]).resolve()) for key in frame if key.endswith("_path")}
    return frame | paths | {"camera_id": int(frame["camera_id"]), "sharpness": None}


REWRITTEN = {
    "one line": ("json", lambda path, value: json.dumps(value, separators=(",", ":"))),
    "CRLF and a byte order mark": (
        "json",
        lambda path, value: "\ufeff" + json.dumps(value, indent=4).replace("\n", "\r\n"),
    ),
    "sorted keys": ("json", lambda path, value: json.dumps(value, sort_keys=True)),
    "keys in the opposite order, as JavaScript writes numbers": (
        "json",
        lambda path, value: json.dumps(upside_down(value)),
    ),
    "absolute paths, numbers as camera ids": (
        "json",
        lambda path, value: json.dumps(
            {**value, "frames": [absolute(f, path.parent) for f in value["frames"]]}
            if "frames" in value
            else value
        ),
    ),
    "compressed": ("npz", lambda stream, arrays: np.savez_compressed(stream, **arrays)),
    "arrays in the opposite order": (
        "npz",
        lambda stream, arrays: np.savez(stream, **dict(reversed(arrays.items()))),
    ),
    "Fortran's order": (
        "npz",
        lambda stream, arrays: np.savez(stream, **{k: np.asfortranarray(v) for k, v in arrays.items()}),
    ),
    "big-endian": (
        "npz",
        lambda stream, arrays: np.savez(stream, **{k: v.astype(">f4") for k, v in arrays.items()}),
    ),
}


@pytest.mark.parametrize("case", REWRITTEN)
def test_a_file_written_again_is_the_same_capture(capture, case):
    expected = read_capture(capture.union, use_cache=False).fingerprint
    suffix, write = REWRITTEN[case]
    for path in capture.union.parent.rglob(f"*.{suffix}"):
        if suffix == "json":
            path.write_text(write(path, json.loads(path.read_text())), newline="")
        elif path.parent.name == "flame_param":
            with np.load(path) as archive:
                arrays = dict(archive)
            write(path, arrays)
    assert read_capture(capture.union, use_cache=False).fingerprint == expected


def test_digests_of_own_files_are_those_of_their_bytes(pristine_capture):
    """Protocols of captures that headbench wrote keep their hashes."""
    union = pristine_capture.union
    files = [*union.parent.rglob("transforms*.json"), *union.parent.rglob("flame_param/*.npz")]
    assert content_digests(files) == {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    declaration = Declaration.read(union)
    expected = hashlib.sha256((union / "headbench.json").read_bytes()).hexdigest()
    assert declaration.digest(declaration.sequences) == expected


@pytest.mark.parametrize(
    ("key", "value"), [("timestep_index_original", 7), ("camera_angle_y", 0.1), ("note", "x")]
)
def test_another_content_is_another_capture(capture, key, value):
    expected = read_capture(capture.union, use_cache=False).fingerprint
    capture.edit("transforms_val.json", lambda document: document["frames"][0].update({key: value}))
    assert read_capture(capture.union, use_cache=False).fingerprint != expected
