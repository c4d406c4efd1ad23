"""Opening captures through a reader: settings, progress, and what the harness asks of any reader's clip."""

import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.bench.engine.captures import open_clips, synthesis_arguments
from headbench.bench.engine.config import RunConfig
from headbench.bench.errors import InputError


@pytest.fixture
def config(toy, tmp_path):
    (tmp_path / "subject1").mkdir()

    def make(reader="toy_plugin:READER", **settings):
        return RunConfig(str(tmp_path), "out", reader=reader, reader_settings=settings)

    return make


def test_settings_reach_the_reader_with_their_types(config, toy, monkeypatch):
    given = {}

    def read(path, *, shift: float = 0.0, cameras: tuple[str, ...] = (), progress=None):
        given.update(shift=shift, cameras=cameras, progress=progress)
        return toy.ToyClip(path)

    monkeypatch.setattr(toy, "read", read)
    assert [clip.subject for clip in open_clips(config(shift=2, cameras="a,b"))] == ["subject1"]
    assert (given["shift"], given["cameras"]) == (2.0, ("a", "b"))
    assert isinstance(given["shift"], float)
    given["progress"](1, 2, "a Progress")


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("cy", "sideways", "one of bottom, centre, top or one of auto"),
        ("teeth", True, "one of add, auto, keep"),
        ("leaks", "ignore", "one of error, record"),
        ("cache_mb", "abc", "a number"),
        ("background", "red", "a number"),
        ("head", [1], "a path"),
        ("progress", 3, "one of"),
        ("use_cache", True, "one of"),
        ("path", "elsewhere", "one of"),
        ("hed", "x", "head"),
    ],
)
def test_a_setting_the_reader_cannot_take_is_named(config, key, value, expected):
    with pytest.raises(InputError) as caught:
        open_clips(config("ga", **{key: value}))
    assert caught.value.file == "reader_settings"
    assert caught.value.key.startswith(key)
    assert expected in caught.value.expected


def test_an_error_inside_a_reader_is_no_wrong_setting(config, toy, monkeypatch):
    def read(path):
        return len(3)

    monkeypatch.setattr(toy, "read", read)
    with pytest.raises(TypeError, match="len"):
        open_clips(config())


def test_what_makes_captures_is_no_reader(config, tmp_path):
    with pytest.raises(InputError, match="one that makes captures"):
        open_clips(config("synthetic"))
    assert [path.name for path in tmp_path.iterdir()] == ["subject1"]


@pytest.mark.parametrize("part", ["subject", "sequence", "camera"])
def test_names_that_lead_out_of_the_run_folder_are_refused(config, toy, monkeypatch, part):
    outside = "../outside"

    def read(path):
        clip = toy.ToyClip(path)
        if part == "subject":
            clip.subject = outside
        elif part == "sequence":
            clip.splits["train"] = tuple(key._replace(sequence=outside) for key in clip.splits["train"])
        else:
            clip.cameras[outside] = Camera(outside, 8, 6, np.eye(3), np.eye(4))
        return clip

    monkeypatch.setattr(toy, "read", read)
    with pytest.raises(InputError) as caught:
        open_clips(config())
    assert caught.value.key == part


def test_two_captures_of_one_subject_are_refused(config, toy, tmp_path, monkeypatch):
    (tmp_path / "subject2").mkdir()
    monkeypatch.setattr(toy, "read", lambda path: toy.ToyClip("same"))
    with pytest.raises(InputError, match="same, same"):
        open_clips(config())


@pytest.mark.parametrize("name", ["out", "pictures", "execution", "workers", "progress"])
def test_a_bundle_decides_nothing_but_what_is_captured(name):
    recorded = {"head": "procedural", "seed": 3}
    steps = [{"parameters": {"synthetic": recorded}}]
    assert synthesis_arguments(steps, "a")["seed"] == 3
    # What a stranger's bundle says of an executor would be run as a script of the shell.
    recorded[name] = {"executor": "slurm", "slurm": {"setup": ["touch owned"]}}
    with pytest.raises(InputError, match=rf"{name}: expected one of .*, seed, .*, found '{name}'"):
        synthesis_arguments(steps, "a")
