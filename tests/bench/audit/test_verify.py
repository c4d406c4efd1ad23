"""A run is as it was recorded; a value, file or capture that differs is found and named."""

import json
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.audit import verify as script
from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.engine import run as runner
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import UnavailableError
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import write_json
from headbench.bench.io.images import read_png, write_png
from headbench.bench.rows import Rows

FRAME = "subject1/toy/seed-0/renders/novel_view/EMO_00000_b.png"


@pytest.fixture
def verify(run, capsys):
    """Exit code and findings of the run."""

    def verify(*options):
        code = cli.main(["verify", str(run), "--trust", "--json", *options])
        (found,) = json.loads(capsys.readouterr().out)["runs"]
        return code, found

    return verify


def change_json(path, change):
    record = read_json(path)
    change(record)
    write_json(path, record)


def test_a_changed_frame_is_found_by_its_values(verify, run):
    write_png(run / FRAME, read_png(run / FRAME) + 3)
    code, found = verify()
    (text,) = found["mismatches"]
    assert code == 1
    assert "psnr (full) of toy, subject1 EMO 0 b: expected" in text


def test_frames_that_the_avatar_does_not_render_are_found(verify, run, toy, monkeypatch):
    for options in ((), ("--render",)):
        code, found = verify(*options)
        # a PSNR of each of 3 + 2 frames, and the number of files
        assert (code, found["values"], found["mismatches"]) == (0, 6, [])
    original = toy.ToyAvatar.render

    def brighter(self, *arguments):
        frame = original(self, *arguments)
        return frame._replace(rgb=frame.rgb + 2 / 255)

    monkeypatch.setattr(toy.ToyAvatar, "render", brighter)
    assert verify()[0] == 0
    code, found = verify("--render")
    assert (code, len(found["mismatches"]), toy.FITS) == (1, 5, [])


def raised(rows):
    rows.loc[(rows["metric"] == "psnr") & (rows["timestep"] == 2), "value"] += 0.01
    return rows


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (raised, "EMO 2 b: expected"),
        (lambda rows: rows.iloc[1:], "found no value"),
        (lambda rows: pd.concat([rows, rows.iloc[:1]]), "found several"),
    ],
)
def test_rows_that_are_changed_missing_or_twice_are_found(verify, run, change, words):
    path = RunFolder(run).rows
    Rows(change(pd.read_parquet(path))).write(path)
    code, found = verify()
    (text,) = found["mismatches"]
    assert code == 1
    assert words in text


def another_level(path):
    change_json(path, lambda record: record["configuration"].update(settings={"toy": {"level": 0.75}}))


def other_rules(folder):
    for path in folder.iterdir():
        change_json(path, lambda record: record.update(quantisation="floor"))


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        (FRAME, Path.unlink, "no such file"),
        (FRAME, lambda path: path.write_bytes(b"no image"), "one that is damaged"),
        (
            "subject1/toy/seed-0/cell.json",
            Path.unlink,
            "the avatar of toy, subject subject1, seed 0, found none",
        ),
        ("run.json", another_level, "cell.json: expected the avatar of toy, subject subject1, seed 0"),
        ("protocols", other_rules, "other frames or rules"),
    ],
)
def test_a_changed_or_missing_file_is_found(verify, run, file, change, words):
    change(run / file)
    code, found = verify()
    assert code == 1
    assert any(words in text for text in found["mismatches"])


def test_another_capture_is_found_whatever_is_cached(verify, toy, monkeypatch):
    def read(path, *, use_cache=True):
        clip = toy.ToyClip(path)
        clip.fingerprint = f"another, cached {use_cache}"
        return clip

    monkeypatch.setattr(toy, "read", read)
    code, found = verify()
    assert code == 1
    assert "expected toy-subject1, found another, cached False" in found["mismatches"][0]


def test_a_metric_that_is_unavailable_here_is_not_verified(verify, monkeypatch):
    def unavailable(*images):
        raise UnavailableError("no weights", "Download them.")

    monkeypatch.setattr("headbench.metrics.psnr.psnr", unavailable)
    code, found = verify()
    assert (code, found["values"]) == (0, 1)
    assert "no weights" in found["unverified"]["psnr"]


def test_what_is_no_finished_run_gives_no_verdict(run, tmp_path):
    replace(RunFolder(run).read_manifest(), status="started").write(RunFolder(run).manifest)
    for folder in (run, tmp_path):
        assert cli.main(["verify", str(folder), "--trust"]) == 3


def test_a_derived_avatar_is_rendered_itself(config, toy, monkeypatch):
    dark = Condition("dark", ("varying",), derive=Named("variant", {"name": "dark"}))
    monkeypatch.setattr(script, "CODED_VARIANT", dark.derive)
    runner.run(replace(config, methods=("toy_plugin:VARYING",), conditions=(PLAIN, dark)))
    assert cli.main(["verify", config.out, "--trust", "--render"]) == 0
