"""Where a run's files are looked for, and which of the modules that it names are imported."""

import os
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from headbench.bench import cli
from headbench.bench.engine import run as runner
from headbench.bench.engine.captures import open_run_clips
from headbench.bench.engine.config import RunOptions
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import write_json
from headbench.reports.page.frames import open_truth

TRUSTED = RunOptions(trust=True)


@pytest.fixture
def run(toy, config, tmp_path, monkeypatch):
    """A run made in a folder of its own: run, capture and head model by relative paths."""

    def read(path, head: str | Path | None = None):
        """Give a clip whose fingerprint depends on what the capture and the head model hold."""
        clip = toy.ToyClip(path)
        clip.fingerprint += Path(head).read_text() + ",".join(sorted(os.listdir(path)))
        return clip

    monkeypatch.setattr(toy, "read", read)
    home = tmp_path / "home"
    home.mkdir()
    (tmp_path / "data").rename(home / "data")
    for name in ("head.npz", "other.npz"):
        (home / name).write_text(name)
    files = {"reader_settings": {"head": "head.npz"}, "heads": {"other": "other.npz"}}
    with monkeypatch.context() as patch:
        patch.chdir(home)
        runner.run(replace(config, data="data", out="run", metrics=("psnr",), **files))
    return home / "run"


def test_a_run_works_from_any_directory(run, tmp_path, monkeypatch):
    recorded = read_json(run / "run.json")["configuration"]
    assert recorded["data"] == str(run.parent / "data")
    assert recorded["reader_settings"] == {"head": str(run.parent / "head.npz")}
    assert recorded["heads"] == {"other": str(run.parent / "other.npz")}
    monkeypatch.chdir(run)
    assert cli.main(["verify", ".", "--trust"]) == 0


def test_another_capture_is_refused(run, capsys):
    (run.parent / "data" / "subject1" / "another.png").touch()
    with pytest.raises(InputError, match="found another .*Name the folder of the capture with --data"):
        open_run_clips(run, TRUSTED)
    assert cli.main(["verify", str(run), "--trust"]) == 1


@pytest.mark.parametrize(
    ("gone", "key", "option"),
    [("data", "data", "--data"), ("head.npz", "reader_settings.head", "--head"), ("other.npz", "heads", "")],
)
def test_what_is_gone_is_named_with_place_and_option(run, tmp_path, capsys, gone, key, option):
    (run.parent / gone).rename(tmp_path / gone)
    assert cli.main(["verify", str(run), "--trust"]) == 3
    out = capsys.readouterr().out
    assert f"configuration.{key}" in out
    assert f"expected {run.parent / gone}, found nothing there" in out
    assert option in out
    if option:
        assert cli.main(["verify", str(run), "--trust", option, str(tmp_path / gone)]) == 0


@pytest.mark.parametrize("key", ["methods", "metrics", "reader"])
def test_a_module_that_a_run_names_is_not_imported(run, monkeypatch, tmp_path, capsys, key):
    """By any command that reads runs; `test_trust` has the cases of the rule."""
    (tmp_path / "stranger.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    record = read_json(run / "run.json")
    registered = {"methods": ["ga"], "metrics": ["psnr"], "reader": "ga", "reader_settings": {}}
    record["configuration"] |= registered | {key: "stranger:SPEC" if key == "reader" else ["stranger:SPEC"]}
    for entry in (*record["metrics"], *record["methods"]):
        entry["implementation"] = "stranger:Class"
    write_json(run / "run.json", record)
    for command, code, needed in (
        (["verify"], 3, ("methods", "metrics", "reader")),
        (["run", "sweep"], 2, ("methods", "metrics", "reader")),
        (["run", "extremes"], 2, ("methods", "metrics", "reader")),
        (["evaluate", str(run), "--out", str(tmp_path / "out"), "--like"], 2, ("metrics", "reader")),
        (["frames", "--out", str(tmp_path / "frames")], 2, ("reader",)),
    ):
        assert cli.main([*command, str(run)]) == code
        shown = "".join(capsys.readouterr())
        told = all(words in shown for words in (f"configuration.{key}", "--trust", "'stranger:SPEC'"))
        assert told == (key in needed), command
    _, reason = open_truth(
        SimpleNamespace(runs=[SimpleNamespace(folder=RunFolder(run), clips=None)]), RunOptions()
    )
    assert ("'stranger:SPEC'" in reason) == (key == "reader")
    assert cli.main(["table", str(run)]) in (0, 2)
    assert "stranger" not in sys.modules
