"""``headbench reenact`` on balls that stand where their pose says."""

import json

import numpy as np
import pandas as pd
import pytest

from headbench.bench.errors import InputError
from headbench.bench.io.frames import read_png
from headbench.reports.robustness.reenact_command import run
from headbench.reports.robustness.settings import ReenactSettings
from headbench.reports.robustness.stability import RECORD_FILE, ROWS_FILE, SHEET_FILE


def settings(folder, **changes):
    return ReenactSettings(str(folder), trust=True, **changes)


def test_every_subject_is_driven_by_the_other_and_keyed_by_both(ball_run):
    folder = ball_run("BALL", "FLOOR")
    found = run(settings(folder))
    out = folder / "cross_reenactment"
    assert found.passed
    rows = pd.read_parquet(out / ROWS_FILE)
    assert set(rows["task"]) == {"cross_reenactment"}
    assert set(rows["method"]) == {"ball"}
    pairs = set(zip(rows["subject"], rows["sequence"], rows["timestep"], rows["camera"]))
    assert pairs == {
        (target, f"{source}/FREE", t, "2")  # the camera held out
        for target, source in (("ball-a", "ball-bee"), ("ball-bee", "ball-a"))
        for t in (4, 5)
    }
    assert (out / SHEET_FILE).exists()


def test_the_protocol_is_an_object_and_identity_says_why_there_is_none(ball_run):
    folder = ball_run("BALL")
    run(settings(folder))
    out = folder / "cross_reenactment"
    rows = pd.read_parquet(out / ROWS_FILE)
    (protocol,) = json.loads((out / RECORD_FILE).read_text())["protocols"]
    assert set(rows["protocol"]) == {protocol["hash"]}
    assert dict(protocol["clips"]) == {"ball-a": "ball-ball-a", "ball-bee": "ball-ball-bee"}
    assert [name for name, _ in protocol["conditions"]] == [
        "ball-a drives ball-bee",
        "ball-bee drives ball-a",
    ]
    identity = rows[rows["metric"] == "identity"]  # a cube has no vertex that follows the head alone
    assert len(identity) == 4
    assert set(identity["status"]) == {"missing"}
    assert identity["reason"].str.contains("no recorded frames").all()


def test_another_performance_is_another_protocol(ball_run):
    folder = ball_run("BALL")
    hashes = set()
    for frames in (1, 2):
        run(settings(folder, frames=frames))
        hashes |= set(pd.read_parquet(folder / "cross_reenactment" / ROWS_FILE)["protocol"])
    assert len(hashes) == 2


def test_the_target_stays_where_its_own_training_was(ball_run):
    """The subjects stand metres apart; a translation taken over as it is would leave the frame empty."""
    folder = ball_run("BALL")
    run(settings(folder))
    rows = pd.read_parquet(folder / "cross_reenactment" / ROWS_FILE)
    coverage = rows[rows["metric"] == "coverage"]["value"]
    assert np.allclose(coverage, 1.0, atol=0.05)


def test_the_source_is_shown_in_the_same_camera(ball_run):
    folder = ball_run("BALL")
    run(settings(folder, camera="1"))
    out = folder / "cross_reenactment"
    (first, *_) = json.loads((out / RECORD_FILE).read_text())["avatars"]
    assert [s["source"] for s in first["shown"]] == [f"sources/ball-bee_FREE_{t:05d}_1.png" for t in (4, 5)]
    source = out / first["shown"][1]["source"]
    assert (read_png(source) == 200).all()
    source.write_bytes(b"")
    run(settings(folder, camera="1"))
    assert (read_png(source) == 200).all()


def test_a_driver_beyond_what_the_avatar_bears_is_found(ball_run, monkeypatch, balls):
    folder = ball_run("BURSTING")
    assert run(settings(folder)).passed
    original = balls.BallClip.__init__

    def wild(self, path, progress=None):
        original(self, path)
        if path.name == "ball-bee":
            self.poses[5].expression[0] = 2.0

    monkeypatch.setattr(balls.BallClip, "__init__", wild)
    assert not run(settings(folder)).passed
    rows = pd.read_parquet(folder / "cross_reenactment" / ROWS_FILE)
    failed = rows[rows["status"] == "failed"]
    assert set(zip(failed["subject"], failed["sequence"], failed["timestep"])) == {
        ("ball-a", "ball-bee/FREE", 5)
    }


def test_a_capture_beside_the_run_can_drive(ball_run, tmp_path):
    folder = ball_run("BALL")
    (tmp_path / "others" / "ball-cool").mkdir(parents=True)
    run(settings(folder, source=str(tmp_path / "others"), frames=1))
    rows = pd.read_parquet(folder / "cross_reenactment" / ROWS_FILE)
    assert set(zip(rows["subject"], rows["sequence"], rows["timestep"])) == {
        ("ball-a", "ball-cool/FREE", 5),
        ("ball-bee", "ball-cool/FREE", 5),
    }


def test_an_absent_camera_is_refused(ball_run):
    folder = ball_run("BALL")
    with pytest.raises(InputError, match="--camera"):
        run(settings(folder, camera="9"))
    with pytest.raises(ValueError, match="frames"):
        settings(folder, frames=0)


def test_a_run_of_one_subject_needs_a_source(ball_run, tmp_path):
    folder = ball_run("BALL")
    (tmp_path / "data" / "ball-bee").rmdir()
    with pytest.raises(InputError, match="--source"):
        run(settings(folder))


def test_a_source_tracked_with_another_head_model_is_refused(ball_run, tmp_path, balls, monkeypatch):
    folder = ball_run("BALL")
    (tmp_path / "others" / "ball-cool").mkdir(parents=True)
    original = balls.BallClip.__init__

    def other_head(self, path, progress=None):
        original(self, path)
        if path.name == "ball-cool":
            self.head.version = "cube"

    monkeypatch.setattr(balls.BallClip, "__init__", other_head)
    with pytest.raises(InputError, match="headbench refit"):
        run(settings(folder, source=str(tmp_path / "others")))
