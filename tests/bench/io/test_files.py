import errno
import os
import re

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from headbench.bench.errors import InputError, UnavailableError, is_damage
from headbench.bench.io import files
from headbench.bench.io.files import (
    KINDS,
    MAX_NAME_BYTES,
    atomic_path,
    check_kind,
    check_name,
    check_writable,
    digest,
    digest_file,
    expand_home,
    reading,
    write_text,
)


def test_a_failed_write_leaves_the_old_file_and_no_rubbish(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def write_half():
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_digests_tell_values_types_shapes_and_order_apart():
    arrays = [np.zeros(4), np.zeros((2, 2)), np.zeros(4, np.float32), np.ones(4)]
    values = [*((array,) for array in arrays), ("ab", "c"), ("a", "bc"), ({"a": 1},), ({"a": 2},)]
    assert len({digest(*value) for value in values}) == len(values)
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})


def test_file_digest_is_sha256(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    # FIPS 180-2, example B.1
    assert digest_file(tmp_path / "a") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


UNFIT = (
    "",
    ".",
    "..",
    ".hidden",
    "../up",
    "/root",
    "a/b",
    "a\\b",
    "C:",
    "a\0",
    "a\n",
    "x" * (MAX_NAME_BYTES + 1),
)


@pytest.mark.parametrize("name", UNFIT)
def test_a_name_that_could_leave_its_folder_is_refused(name):
    with pytest.raises(InputError) as caught:
        check_name(name, "capture.json", "subject")
    assert (caught.value.file, caught.value.key) == ("capture.json", "subject")


@given(st.text(min_size=1, max_size=200))
@example("EMO-1-shout+laugh")
@example("Kopf 3 (neu)")
@example("a..b")
def test_an_accepted_name_stays_directly_in_its_folder(name):
    try:
        assert check_name(name, "capture.json", "subject") == name
    except InputError:
        assert not re.fullmatch(r"\w[\w ()+.-]{0,99}", name, re.ASCII)
        return
    assert os.path.dirname(os.path.normpath(f"/folder/{name}")) == "/folder"


def test_a_file_is_flushed_before_its_rename(tmp_path, monkeypatch):
    """Filesystems that write later report a full disk only here."""
    path, seen = tmp_path / "new" / "a", []
    monkeypatch.setattr(
        files, "_flush", lambda temporary: seen.append((temporary.read_text(), path.exists()))
    )
    write_text(path, "old")
    assert seen == [("old", False)]

    def fail(temporary):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files, "_flush", fail)
    with pytest.raises(OSError, match="No space") as caught:
        write_text(path, "new")
    assert caught.value.filename == str(path)
    assert {path.name: path.read_text() for path in path.parent.iterdir()} == {"a": "old"}


@pytest.mark.parametrize("target", ["a", "victim", "nothing"])
def test_a_link_is_replaced_and_its_target_left_alone(tmp_path, target):
    (tmp_path / "victim").write_text("victim")
    (tmp_path / "a").symlink_to(tmp_path / target)
    write_text(tmp_path / "a", "ours")
    assert (tmp_path / "victim").read_text() == "victim"
    assert not (tmp_path / "a").is_symlink()
    assert (tmp_path / "a").read_text() == "ours"
    assert not (tmp_path / "nothing").exists()


@pytest.mark.parametrize(("kind", "mark"), [(kind, mark) for kind in KINDS for mark in KINDS[kind]])
def test_a_folder_of_another_kind_is_refused(tmp_path, kind, mark):
    check_kind(tmp_path / "new")
    place = tmp_path / mark.replace("*", "x")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.touch()
    check_kind(tmp_path, kind)
    for own in ((), tuple(other for other in KINDS if other != kind)):
        with pytest.raises(InputError, match="--out: expected a new folder") as caught:
            check_kind(tmp_path, *own)
        assert caught.value.found == f"{kind} ({place.relative_to(tmp_path)})"


def test_results_are_not_written_over_by_a_named_file(tmp_path):
    (tmp_path / "target.md").write_text("notes")
    (tmp_path / "link.md").symlink_to(tmp_path / "target.md")
    for name in ("run.json", "rows.parquet", "transforms_test.json", "cameras.bin", "link.md"):
        if name != "link.md":
            check_writable(tmp_path / name, "--out")  # nothing is there yet
            (tmp_path / name).write_text("{}")
        with pytest.raises(InputError, match="--out: expected a file that is new"):
            check_writable(tmp_path / name, "--out")
    check_writable(tmp_path / "target.md", "--out")  # a table of an earlier time


def test_a_tilde_is_the_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/h")
    for text, expected in {"~/a b": "/h/a b", "~": "/h", "a/~/b": "a/~/b", "~ours": "~ours", "": ""}.items():
        assert expand_home(text, "run.yaml") == expected
    with pytest.raises(
        InputError, match="run.yaml, ~nobody-of-that-name/a: expected a path in a home folder"
    ):
        expand_home("~nobody-of-that-name/a", "run.yaml")


@pytest.mark.parametrize(
    ("error", "found", "damage"),
    [
        (ValueError("first line\nsecond"), "unreadable content (ValueError: first line)", True),
        (KeyError(), "unreadable content (KeyError)", True),
        (RecursionError("too deep"), "unreadable content (RecursionError: too deep)", True),
        (OSError("of a library"), "unreadable content (OSError: of a library)", True),
        (ValueError("\x1b" + "x" * 10_000), None, True),
        (MemoryError(), "too little memory to read it", False),
        (FileNotFoundError(errno.ENOENT, "gone"), "no such file", False),
        (OSError(errno.EIO, "Input/output error"), "Input/output error", False),
    ],
    ids=repr,
)
def test_what_a_library_raises_becomes_one_input_error(tmp_path, error, found, damage):
    with pytest.raises(InputError) as caught, reading(tmp_path / "a.npz", "a NumPy archive", "x", "Remedy."):
        raise error
    refused = caught.value
    assert refused.__cause__ is error
    assert is_damage(refused) is damage
    assert (refused.file, refused.key, refused.expected) == (str(tmp_path / "a.npz"), "x", "a NumPy archive")
    assert refused.remedy == "Remedy."
    assert str(refused).isprintable()
    assert len(str(refused)) < 1000
    assert found in (None, refused.found)


@pytest.mark.parametrize(
    "error",
    [
        InputError("a", "", "one thing", "another"),
        UnavailableError("A package is not installed.", "Install it."),
        OSError(errno.ENOSPC, "No space left on device"),
        KeyboardInterrupt(),
    ],
    ids=repr,
)
def test_what_says_nothing_of_the_file_passes(tmp_path, error):
    with pytest.raises(type(error)) as caught, reading(tmp_path / "a.npz", "a NumPy archive"):
        raise error
    assert caught.value is error
