"""``avatar.json``, and the one way to load what lies beside it."""

import json
import shutil

import numpy as np
import pytest

from headbench.bench.engine.stored import AVATAR_FILE, HEAD_FILE, load_avatar, open_avatar
from headbench.bench.errors import InputError
from headbench.methods.ga.method import GAAvatar

from ...world import finished


@pytest.fixture(scope="module")
def cell():
    return finished().cell("901", "ga", 0)


@pytest.fixture
def folder(cell, tmp_path):
    shutil.copytree(cell.avatar, tmp_path / "moved")
    return tmp_path / "moved"


def change(folder, **values):
    record = json.loads((folder / AVATAR_FILE).read_text())
    (folder / AVATAR_FILE).write_text(json.dumps(record | values))


def test_an_avatar_is_loaded_from_its_cell_or_from_anywhere(cell, folder):
    for place in (cell.folder, cell.avatar, folder, str(folder)):
        assert isinstance(load_avatar(place), GAAvatar)
    stored = open_avatar(folder)
    assert stored.record["method"] == "ga"
    assert stored.record["made_by"] == "training"
    assert stored.record["origin"]["seed"] == 0
    trained = cell.record["method"]
    assert stored.method.record()["config"] == trained["config"]
    assert stored.heads == {stored.record["head_model"]: str(folder / HEAD_FILE)}


def test_what_it_shows_is_told_from_other_subjects(folder):
    stored = open_avatar(folder)
    shape = np.array(stored.record["shape"])
    model = stored.record["head_model"]
    assert stored.shows_another("902", shape, model) == ""  # the same shape by another name
    assert stored.shows_another("901", shape + 0.1, model) == "901"
    assert stored.shows_another("901", shape + 0.1, "another model") == ""
    assert stored.shows_another("902", shape, "another model") == "901"


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"format": 2}, "format"),
        ({"method": "of-a-plug-in"}, "method: expected a method that is registered here.*--method package"),
        ({"method": "insta"}, "settings"),
        ({"settings": None}, "settings: expected settings, found none"),
        ({"settings": {"sh_degree": 9}}, "sh_degree must be 0 to 3"),
        ({"resolution": {"divide": 0}}, "resolution"),
        ({"shape": [0.0, 1e30]}, "shape"),
        (
            {"made_by": "variant"},
            "made_by: expected an avatar that its method reads, found .*`coded`.*export compact",
        ),
        ({"more": 1}, "more"),
    ],
)
def test_a_record_that_does_not_fit_is_refused_by_its_key(folder, values, says):
    change(folder, **values)
    with pytest.raises(InputError, match=says) as caught:
        open_avatar(folder)
    assert AVATAR_FILE in str(caught.value)


def test_what_is_no_whole_avatar_is_refused(cell, folder, tmp_path):
    head = folder / HEAD_FILE
    head.write_bytes(head.read_bytes() + b"\0")
    with pytest.raises(InputError, match="expected the head model that the avatar was stored with"):
        load_avatar(folder)
    head.unlink()
    with pytest.raises(InputError, match="found no such file"):
        load_avatar(folder)
    (folder / AVATAR_FILE).unlink()
    run = cell.folder.parents[2]
    for place, says in (
        (folder, r"without avatar\.json"),
        (run, "SUBJECT/METHOD"),
        (tmp_path / "x", "no such folder"),
    ):
        with pytest.raises(InputError, match=says):
            open_avatar(place)


def test_a_method_that_is_not_registered_is_named(folder, caplog):
    change(folder, version="0")
    assert isinstance(load_avatar(folder, method="headbench.methods.ga.spec:GA"), GAAvatar)
    assert "made by version 0 of ga" in caplog.text
    with pytest.raises(InputError, match="--method"):
        open_avatar(folder, "headbench.methods.ours.spec:OURS")
