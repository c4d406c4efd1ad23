import errno
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.bench.files import (
    MAX_NAME_BYTES,
    atomic_path,
    check_name,
    digest,
    digest_file,
    read_json,
    write_json,
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


def test_results_are_readable_whatever_their_writer_makes_of_the_file(tmp_path):
    """safetensors writes beside the file it is given and renames, which leaves the mode of a private file."""
    path = tmp_path / "a.txt"
    with atomic_path(path) as temporary:
        private = temporary.with_name("private")
        private.write_text("new")
        private.chmod(0o600)
        private.replace(temporary)
    usual = tmp_path / "b.txt"
    usual.write_text("usual")
    assert path.stat().st_mode == usual.stat().st_mode


def test_the_temporary_name_keeps_the_suffix(tmp_path):
    with atomic_path(tmp_path / "new" / "a.png") as temporary:
        assert temporary.suffix == ".png"


def test_digests_tell_values_types_shapes_and_order_apart():
    values = [
        (np.zeros(4),),
        (np.zeros((2, 2)),),
        (np.zeros(4, np.float32),),
        (np.ones(4),),
        ("ab", "c"),
        ("a", "bc"),
        ({"a": 1},),
        ({"a": 2},),
    ]
    assert len({digest(*value) for value in values}) == len(values)
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})


def test_file_digest_is_sha256(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    # FIPS 180-2, example B.1
    assert digest_file(tmp_path / "a") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_json_takes_numpy(tmp_path):
    write_json(tmp_path / "a.json", {"x": np.float32(0.5), "y": np.arange(2), "p": tmp_path, "s": {"b", "a"}})
    assert '"x": 0.5' in (tmp_path / "a.json").read_text()


@pytest.mark.parametrize("text", ["", "{", "[" * 200_000, "[1]", "3", '"text"', "\ufeff{}"])
def test_json_that_is_no_object_is_refused_in_one_paragraph(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_json(path)
    assert caught.value.file == str(path)
    assert "\n" not in str(caught.value)


def test_json_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_json(tmp_path / "none.json")
    with pytest.raises(InputError, match="readable"):
        read_json(tmp_path)
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x81")
    with pytest.raises(InputError, match="does not parse"):
        read_json(tmp_path / "bytes.json")


@pytest.mark.parametrize(
    "name",
    [
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
    ],
)
def test_a_name_that_could_leave_its_folder_is_refused(name):
    with pytest.raises(InputError) as caught:
        check_name(name, "capture.json", "subject")
    assert (caught.value.file, caught.value.key) == ("capture.json", "subject")


@given(st.text(min_size=1, max_size=200))
def test_an_accepted_name_stays_directly_in_its_folder(tmp_path_factory, name):
    try:
        check_name(name, "capture.json", "subject")
    except InputError:
        return
    folder = tmp_path_factory.getbasetemp()
    assert os.path.dirname(os.path.normpath(folder / name)) == str(folder)


@pytest.mark.parametrize("name", ["074", "EMO-1-shout+laugh", "222200037", "Kopf 3 (neu)", "面", "a..b"])
def test_names_of_the_field_are_accepted(name):
    assert check_name(name, "", "") == name


def test_a_disk_that_fills_up_is_told_with_the_file_meant(tmp_path):
    with pytest.raises(OSError, match="a.png") as caught, atomic_path(tmp_path / "a.png"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.filename == str(tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_ones_own_keeps_its_words(tmp_path):
    with pytest.raises(OSError, match="^nothing of the system$"), atomic_path(tmp_path / "a.png"):
        raise OSError("nothing of the system")
