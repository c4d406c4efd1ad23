"""A run is as it claims; every way of changing it on disk is found and told by file, expected and found."""

import json

import pytest

from headbench.bench import cli
from headbench.bench.files import digest_file, read_json, write_json
from headbench.bench.frames import read_png, write_png
from headbench.bench.store import RunFolder, read_rows, write_rows


def verify(run, *options):
    return cli.main(["verify", str(run), *options])


def cell_of(run):
    return RunFolder(run).cell("subject1", "toy", 0)


def frame_of(run):
    return min((cell_of(run).folder / "renders" / "novel_view").iterdir())


def test_an_untouched_run_verifies_and_says_how_much_was_looked_at(run, capsys):
    assert verify(run, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    # 3 + 2 frames and the avatar's file; a PSNR of each frame and the number of files
    assert (found["files"], found["values"], found["mismatches"]) == (6, 6, [])


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
    frame.write_bytes(frame.read_bytes() + b"\0")
    capsys.readouterr()
    assert verify(run) == 1
    assert "1 mismatches" in capsys.readouterr().out


def test_a_changed_value_is_found(run, capsys):
    folder = RunFolder(run)
    rows = read_rows(folder.rows)
    rows.loc[(rows["metric"] == "psnr") & (rows["timestep"] == 2), "value"] += 0.01
    write_rows(folder.rows, rows)
    assert verify(run) == 1
    out = capsys.readouterr().out
    assert "1 mismatches" in out
    assert "EMO 2 b: expected" in out


@pytest.mark.parametrize(("change", "found"), [("drop", "a row with"), ("repeat", "found several")])
def test_rows_that_are_missing_or_twice_are_found(run, change, found, capsys):
    folder = RunFolder(run)
    rows = read_rows(folder.rows)
    import pandas as pd

    write_rows(folder.rows, rows.iloc[1:] if change == "drop" else pd.concat([rows, rows.iloc[:1]]))
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


def test_a_changed_frame_stays_found_after_the_run_is_started_again(run, toy, capsys):
    from headbench.bench import runner
    from headbench.bench.robustness.avatars import run_configuration

    frame = frame_of(run)
    write_png(frame, read_png(frame) + 3)
    runner.run(run_configuration(run))
    assert verify(run) == 1


def test_an_unfinished_run_is_bad_input(run, tmp_path, capsys):
    RunFolder(run).write_manifest({**RunFolder(run).read_manifest(), "status": "started"})
    assert verify(run) == 2
    assert verify(tmp_path) == 2
