"""Opening captures through a reader: settings, progress, and what the harness asks of any reader's clip."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.contracts import Camera
from headbench.bench.engine.captures import (
    PROGRAMS,
    check_trusted,
    open_clips,
    run_configuration,
    synthesis_arguments,
)
from headbench.bench.engine.config import RunConfig, RunOptions
from headbench.bench.errors import InputError
from headbench.bench.manifest import Manifest

OTHERS = "stranger:SPEC"


@pytest.mark.parametrize("trust", [False, True])
@pytest.mark.parametrize(
    ("key", "name", "given", "allowed"),
    [
        ("methods", "ga", {}, True),
        ("methods", OTHERS, {}, False),
        ("methods", OTHERS, {OTHERS}, True),
        ("methods", OTHERS, {"other:SPEC"}, False),
        ("reader", OTHERS, {}, False),
        ("conditions", "", {}, True),
        (PROGRAMS, "ga-official", {}, False),
        (PROGRAMS, "ga-official", {"ga-official"}, True),
    ],
)
def test_the_rule(key, name, given, allowed, trust):
    def check():
        check_trusted(Path("run.json"), {"tasks": ("novel_view",), key: (name,)}, given, trust=trust)

    if allowed or trust:
        check()
        return
    with pytest.raises(InputError, match=f"configuration.{key}: .*'{name}'"):
        check()


CHANGED = Condition("changed", clip=Named(OTHERS))
RUN = {
    "method": ({"methods": ("ga", OTHERS)}, "methods"),
    "metric": ({"metrics": ("psnr", OTHERS)}, "metrics"),
    "profile": ({"metric_profiles": ("canonical", OTHERS)}, "metric_profiles"),
    "change of a condition": ({"conditions": (PLAIN, CHANGED)}, "conditions"),
    "reader": ({"reader": OTHERS}, "reader"),
    "change of captures": ({"clip": Named(OTHERS)}, "conditions"),
}
"""Changes of a run's configuration, and the key of what they run."""


@pytest.mark.parametrize("case", sorted(RUN))
def test_commands_that_read_a_run_apply_it(tmp_path, monkeypatch, case):
    monkeypatch.setattr("headbench.bench.engine.captures._named", lambda config: {"data": config.data})
    changes, key = RUN[case]
    plain = RunConfig(str(tmp_path), str(tmp_path), methods=("ga",), metrics=("psnr",))
    Manifest(replace(plain, **changes), (), (), (), {}, {}).write(tmp_path / "run.json")
    with pytest.raises(InputError, match=f"configuration.{key}: .*--trust"):
        run_configuration(tmp_path, RunOptions())
    assert run_configuration(tmp_path, RunOptions(trust=True)).data == str(tmp_path)


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


WRONG = {
    "cy": "sideways",
    "teeth": True,
    "cache_mb": "abc",
    "head": [1],
    "progress": 3,
    "path": "x",
    "hed": "x",
}


@pytest.mark.parametrize("key", WRONG)
def test_a_setting_the_reader_cannot_take_is_named(config, key):
    with pytest.raises(InputError) as caught:
        open_clips(config("ga", **{key: WRONG[key]}))
    assert caught.value.file == "reader_settings"
    assert caught.value.key.startswith(key)


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


@pytest.mark.parametrize("part", ["subject", "sequence", "camera", "the same subject"])
def test_names_that_lead_out_or_are_not_unique_are_refused(config, toy, tmp_path, monkeypatch, part):
    outside = "../outside"
    (tmp_path / "subject2").mkdir()

    def read(path):
        clip = toy.ToyClip("same" if part == "the same subject" else path)
        if part == "subject":
            clip.subject = outside
        elif part == "sequence":
            clip.splits["train"] = tuple(key._replace(sequence=outside) for key in clip.splits["train"])
        elif part == "camera":
            clip.cameras[outside] = Camera(outside, 8, 6, np.eye(3), np.eye(4))
        return clip

    monkeypatch.setattr(toy, "read", read)
    with pytest.raises(InputError, match="same, same" if part == "the same subject" else f"{part}: "):
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
