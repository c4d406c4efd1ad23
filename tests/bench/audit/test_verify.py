"""A run is as it claims; every way of changing it on disk is found and told by file, expected and found."""

import dataclasses
import json

import cv2
import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import digest_file, write_json
from headbench.bench.io.images import read_png, write_png
from headbench.bench.rows import Rows
from headbench.bench.runner.store import RunFolder


def verify(run, *options):
    return cli.main(["verify", str(run), "--trust", *options])


def cell_of(run):
    return RunFolder(run).cell("subject1", "toy", 0)


def frame_of(run):
    return min((cell_of(run).folder / "renders" / "novel_view").iterdir())


def test_an_untouched_run_verifies_and_says_how_much_was_looked_at(run, capsys):
    assert verify(run, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    # 3 + 2 frames and the avatar's file; a PSNR of each frame and the number of files
    assert (found["files"], found["values"], found["mismatches"]) == (6, 6, [])


def test_captures_are_read_whole_whatever_is_remembered(run, toy, monkeypatch):
    asked = []

    def read(path, *, remembered=True):
        asked.append(remembered)
        return toy.ToyClip(path)

    monkeypatch.setattr(toy, "read", read)
    assert verify(run) == 0
    assert asked == [False]


def test_a_changed_frame_is_found_by_digest_and_by_metric(run, capsys):
    frame = frame_of(run)
    before = digest_file(frame)[:12]
    write_png(frame, read_png(frame) + 3)
    assert verify(run) == 1
    out = capsys.readouterr().out
    assert f"{frame}, digest: expected {before}, found {digest_file(frame)[:12]}" in out
    assert "rows.parquet, psnr (full) of toy, subject1 EMO 0 b: expected" in out


def test_a_frame_recompressed_without_loss_has_another_digest_and_the_same_metric(run, capsys):
    frame = frame_of(run)
    write_png(frame, read_png(frame))  # the same bytes again
    assert verify(run) == 0
    frame.write_bytes(
        cv2.imencode(".png", cv2.imread(str(frame)), [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    )
    capsys.readouterr()
    assert verify(run) == 1
    assert "1 mismatches" in capsys.readouterr().out


def test_a_changed_value_is_found(run, capsys):
    folder = RunFolder(run)
    rows = pd.read_parquet(folder.rows)
    rows.loc[(rows["metric"] == "psnr") & (rows["timestep"] == 2), "value"] += 0.01
    Rows(rows).write(folder.rows)
    assert verify(run) == 1
    out = capsys.readouterr().out
    assert "1 mismatches" in out
    assert "EMO 2 b: expected" in out


@pytest.mark.parametrize(("change", "found"), [("drop", "a row with"), ("repeat", "found several")])
def test_rows_that_are_missing_or_twice_are_found(run, change, found, capsys):
    folder = RunFolder(run)
    rows = pd.read_parquet(folder.rows)
    Rows(rows.iloc[1:] if change == "drop" else pd.concat([rows, rows.iloc[:1]])).write(folder.rows)
    assert verify(run) == 1
    assert found in capsys.readouterr().out


def test_a_missing_frame_and_missing_digests_are_found(run, capsys):
    frame = frame_of(run)
    frame.unlink()
    assert verify(run) == 1
    assert f"{frame}: expected a file of digest" in capsys.readouterr().out
    (cell_of(run).folder / "digests.json").unlink()
    assert verify(run) == 1
    assert "digests.json, files, renders/novel_view" in capsys.readouterr().out


def test_a_changed_avatar_is_found(run, capsys):
    (cell_of(run).avatar / "level.txt").write_text("0.75")
    assert verify(run) == 1
    assert "level.txt, digest: expected" in capsys.readouterr().out


def test_settings_that_are_not_those_of_the_avatar_are_found(run, capsys):
    folder = RunFolder(run)
    record = read_json(folder.manifest)
    record["configuration"]["settings"] = {"toy": {"level": 0.75}}
    write_json(folder.manifest, record)
    assert verify(run) == 1
    assert "fit.json, fingerprint: expected" in capsys.readouterr().out


def test_a_changed_protocol_is_found_by_its_field(run, capsys):
    folder = RunFolder(run)
    record = read_json(folder.manifest)
    record["protocols"]["novel_view"]["quantisation"] = "floor"
    write_json(folder.manifest, record)
    assert verify(run) == 1
    assert (
        "protocols.novel_view.quantisation: expected round-to-8-bit, found floor" in capsys.readouterr().out
    )


def test_a_changed_capture_is_found(run, toy, monkeypatch, capsys):
    def read(path):
        clip = toy.ToyClip(path)
        clip.fingerprint = "another"
        return clip

    monkeypatch.setattr(toy, "read", read)
    assert verify(run) == 1
    assert "fingerprint of subject1: expected toy-subject1, found another" in capsys.readouterr().out


def test_a_run_started_again_renders_a_changed_frame_again(run, toy, capsys):
    from headbench.bench.runner import run as runner
    from headbench.bench.runner.captures import run_configuration
    from headbench.bench.runner.config import RunOptions

    frame = frame_of(run)
    before = digest_file(frame)
    write_png(frame, read_png(frame) + 3)
    assert verify(run) == 1
    runner.run(run_configuration(run, RunOptions(trust=True)))
    assert digest_file(frame) == before
    assert verify(run) == 0


def test_an_unfinished_run_gives_no_verdict(run, tmp_path, capsys):
    started = dataclasses.replace(RunFolder(run).read_manifest(), status="started")
    started.write(RunFolder(run).manifest)
    assert verify(run) == 3
    assert verify(tmp_path) == 3
