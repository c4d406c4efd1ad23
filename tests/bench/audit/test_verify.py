"""A run is as it claims; every way of changing it on disk is found and named by file, expected and found."""

import dataclasses
import json
import re
from pathlib import Path

import cv2
import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.engine import run as runner
from headbench.bench.engine.captures import run_configuration
from headbench.bench.engine.config import RunOptions
from headbench.bench.engine.store import RunFolder
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import digest_file, write_json
from headbench.bench.io.images import read_png, write_png
from headbench.bench.rows import Rows


def verify(run, *options):
    return cli.main(["verify", str(run), "--trust", *options])


@pytest.fixture
def frame(cell):
    """The first stored frame."""
    return cell.folder / "renders" / "novel_view" / "EMO_00000_b.png"


@pytest.fixture
def found(run, capsys):
    """What is printed of a run that is not as it claims."""

    def found():
        assert verify(run) == 1
        return capsys.readouterr().out

    return found


def change_json(path, change):
    record = read_json(path)
    change(record)
    write_json(path, record)


def test_an_untouched_run_verifies_with_the_counts_checked(run, capsys):
    assert verify(run, "--json") == 0
    (found,) = json.loads(capsys.readouterr().out)["runs"]
    # 3 + 2 frames, the avatar's file and its record; a PSNR of each frame and the number of files
    assert (found["files"], found["values"], found["mismatches"]) == (7, 6, [])


def test_captures_are_read_whole_whatever_is_remembered(run, toy, monkeypatch):
    asked = []

    def read(path, *, use_cache=True):
        asked.append(use_cache)
        return toy.ToyClip(path)

    monkeypatch.setattr(toy, "read", read)
    assert verify(run) == 0
    assert asked == [False]


def test_a_changed_frame_is_found_and_rendered_again_by_the_run(run, frame, found):
    before = digest_file(frame)
    write_png(frame, read_png(frame) + 3)
    out = found()
    assert f"{frame}, digest: expected {before[:12]}, found {digest_file(frame)[:12]}" in out
    assert "rows.parquet, psnr (full) of toy, subject1 EMO 0 b: expected" in out
    runner.run(run_configuration(run, RunOptions(trust=True)))
    assert digest_file(frame) == before
    assert verify(run) == 0


def test_a_frame_recompressed_without_loss_keeps_its_pixels(run, frame, found):
    write_png(frame, read_png(frame))  # the same bytes again
    assert verify(run) == 0
    compression = [cv2.IMWRITE_PNG_COMPRESSION, 9]
    frame.write_bytes(cv2.imencode(".png", cv2.imread(str(frame)), compression)[1].tobytes())
    assert "1 mismatches" in found()


def raised(rows):
    rows.loc[(rows["metric"] == "psnr") & (rows["timestep"] == 2), "value"] += 0.01
    return rows


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (raised, r"1 mismatches(.|\n)*EMO 2 b: expected"),
        (lambda rows: rows.iloc[1:], "a row with"),
        (lambda rows: pd.concat([rows, rows.iloc[:1]]), "found several"),
    ],
)
def test_rows_that_are_changed_missing_or_twice_are_found(run, found, change, words):
    path = RunFolder(run).rows
    Rows(change(pd.read_parquet(path))).write(path)
    assert re.search(words, found())


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("renders/novel_view/EMO_00000_b.png", Path.unlink, "EMO_00000_b.png: expected a file of digest"),
        ("digests.json", Path.unlink, "digests.json, files, renders/novel_view"),
        ("avatar/level.txt", lambda path: path.write_text("0.75"), "level.txt, digest: expected"),
        (
            "../../../run.json",
            lambda path: change_json(
                path, lambda r: r["configuration"].update(settings={"toy": {"level": 0.75}})
            ),
            "fit.json, fingerprint: expected",
        ),
        (
            "../../../protocols",
            lambda folder: [
                change_json(path, lambda r: r.update(quantisation="floor")) for path in folder.iterdir()
            ],
            "protocols.novel_view.quantisation: expected round-to-8-bit, found floor",
        ),
    ],
)
def test_a_changed_or_missing_file_is_found(cell, found, run, file, change, words):
    change(cell.folder / file)
    assert words in found()


def test_a_changed_capture_is_found(toy, monkeypatch, found):
    def read(path):
        clip = toy.ToyClip(path)
        clip.fingerprint = "another"
        return clip

    monkeypatch.setattr(toy, "read", read)
    assert "fingerprint of subject1: expected toy-subject1, found another" in found()


def test_an_unfinished_run_gives_no_verdict(run, tmp_path):
    started = dataclasses.replace(RunFolder(run).read_manifest(), status="started")
    started.write(RunFolder(run).manifest)
    assert verify(run) == 3
    assert verify(tmp_path) == 3


def test_cells_are_verified_by_tasks_of_an_executor(run, frame, tmp_path, capsys):
    write_png(frame, read_png(frame) + 3)
    found = []
    for more in ([], ["--executor", "processes", "--workers", "1", "--out", str(tmp_path / "out")]):
        assert verify(run, "--json", *more) == 1
        found.append(json.loads(capsys.readouterr().out))
    assert found[0] == found[1] == read_json(tmp_path / "out" / "verify.json")
    assert len(found[0]["runs"][0]["mismatches"]) == 2


def test_renders_that_were_cleaned_are_one_finding(run, found):
    assert cli.main(["status", str(run), "--clean", "renders"]) == 0
    out = found()
    assert "1 mismatches" in out
    assert "`headbench status --clean renders`" in out
