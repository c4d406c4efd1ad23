"""``headbench run reenact`` on balls that stand where their pose says."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import HeadPose
from headbench.bench.errors import InputError
from headbench.bench.experiments.reenactment import RigidMean, retarget
from headbench.bench.experiments.robustness import RECORD_FILE, ReenactSettings, reenact_run
from headbench.bench.io.images import read_png
from headbench.reports.contact_sheet import SHEET_FILE


def settings(folder, **changes):
    return ReenactSettings(str(folder), trust=True, **changes)


def test_every_subject_is_driven_by_the_other_and_keyed_by_both(ball_run):
    folder = ball_run("BALL", "FLOOR")
    found = reenact_run(settings(folder))
    out = folder / "cross_reenactment"
    assert found.passed
    rows = pd.read_parquet(out / "rows.parquet")
    assert set(rows["task"]) == {"cross_reenactment"}
    assert set(rows["method"]) == {"ball"}
    pairs = set(zip(rows["subject"], rows["sequence"], rows["timestep"], rows["camera"]))
    assert pairs == {
        (target, f"{source}/FREE", t, "2")  # the camera held out
        for target, source in (("ball-a", "ball-bee"), ("ball-bee", "ball-a"))
        for t in (4, 5)
    }
    assert (out / SHEET_FILE).exists()
    # The subjects stand metres apart; a translation taken over as it is would leave the frame empty.
    assert np.allclose(rows[rows["metric"] == "coverage"]["value"], 1.0, atol=0.05)
    (protocol,) = json.loads((out / RECORD_FILE).read_text())["protocols"]
    assert set(rows["protocol"]) == {protocol["hash"]}
    assert dict(protocol["clips"]) == {"ball-a": "ball-ball-a", "ball-bee": "ball-ball-bee"}
    conditions = [name for name, _ in protocol["conditions"]]
    assert conditions == ["ball-a drives ball-bee", "ball-bee drives ball-a"]
    identity = rows[rows["metric"] == "identity"]  # a cube has no vertex that follows the head alone
    assert len(identity) == 4
    assert set(identity["status"]) == {"missing"}
    assert identity["reason"].str.contains("no recorded frames").all()


@pytest.mark.usefixtures("no_sheets")
def test_another_performance_is_another_protocol(ball_run):
    folder = ball_run("BALL")
    hashes = set()
    for frames in (1, 2):
        out = folder / f"frames-{frames}"
        reenact_run(settings(folder, frames=frames, out=str(out)))
        hashes |= set(pd.read_parquet(out / "rows.parquet")["protocol"])
    assert len(hashes) == 2
    with pytest.raises(InputError, match="choose another --out"):  # the rows of two frames would be lost
        reenact_run(settings(folder, frames=1, out=str(out)))


@pytest.mark.usefixtures("no_sheets")
def test_the_source_is_shown_in_the_same_camera(ball_run):
    folder = ball_run("BALL")
    reenact_run(settings(folder, camera="1"))
    out = folder / "cross_reenactment"
    (first, *_) = json.loads((out / RECORD_FILE).read_text())["avatars"]
    assert [s["source"] for s in first["shown"]] == [f"sources/ball-bee_FREE_{t:05d}_1.png" for t in (4, 5)]
    source = out / first["shown"][1]["source"]
    assert (read_png(source) == 200).all()


@pytest.mark.usefixtures("no_sheets")
def test_a_driver_beyond_what_the_avatar_bears_is_found(ball_run, monkeypatch, balls):
    folder = ball_run("BURSTING")
    assert reenact_run(settings(folder)).passed
    original = balls.BallClip.__init__

    def wild(self, path, progress=None):
        original(self, path)
        if path.name == "ball-bee":
            self.poses[5].expression[0] = 2.0

    monkeypatch.setattr(balls.BallClip, "__init__", wild)
    out = folder / "wild"
    assert not reenact_run(settings(folder, out=str(out))).passed
    rows = pd.read_parquet(out / "rows.parquet")
    failed = rows[rows["status"] == "failed"]
    assert set(zip(failed["subject"], failed["sequence"], failed["timestep"])) == {
        ("ball-a", "ball-bee/FREE", 5)
    }


@pytest.mark.usefixtures("no_sheets")
def test_a_source_beside_the_run_and_what_is_refused(ball_run, tmp_path, balls, monkeypatch):
    folder, others = ball_run("BALL"), tmp_path / "others"
    (others / "ball-cool").mkdir(parents=True)
    reenact_run(settings(folder, source=str(others), frames=1))
    rows = pd.read_parquet(folder / "cross_reenactment" / "rows.parquet")
    assert set(zip(rows["subject"], rows["sequence"], rows["timestep"])) == {
        (subject, "ball-cool/FREE", 5) for subject in ("ball-a", "ball-bee")
    }
    with pytest.raises(InputError, match="--camera"):
        reenact_run(settings(folder, camera="9", out=str(tmp_path / "out")))
    original, changes = (
        balls.BallClip.__init__,
        [{"version": "cube"}, {"expression_basis": np.zeros((8, 3, 4))}],
    )

    def other_head(self, path, progress=None):
        original(self, path)
        if path.name == "ball-cool":
            vars(self.head).update(changes[-1])

    with monkeypatch.context() as patch:
        patch.setattr(balls.BallClip, "__init__", other_head)
        while changes:
            with pytest.raises(InputError, match="headbench prepare refit"):
                reenact_run(settings(folder, source=str(others), out=str(tmp_path / "out")))
            changes.pop()
    (tmp_path / "data" / "ball-bee").rmdir()
    with pytest.raises(InputError, match="--source"):
        reenact_run(settings(folder, data=str(tmp_path / "data"), out=str(tmp_path / "out")))


def poses(seed, count=5, spread=0.3):
    rng = np.random.default_rng(seed)
    base = rng.normal(size=3)

    def turn():
        return (Rotation.from_rotvec(base) * Rotation.from_rotvec(spread * rng.normal(size=3))).as_rotvec()

    def random(*sizes):
        return [rng.normal(size=size) for size in sizes]

    return [
        HeadPose(
            *("m", *random(4), turn(), spread * rng.normal(size=3), *random(3, 6)),
            *(base + 0.01 * rng.normal(size=3), *random(2), "source", t),
        )
        for t in range(count)
    ]


def same_turn(a, b):
    return np.allclose(Rotation.from_rotvec(a).as_matrix(), Rotation.from_rotvec(b).as_matrix(), atol=1e-6)


def test_the_mean_is_that_of_scipy():
    many = poses(1, 20)
    mean = RigidMean.of(many)
    assert np.allclose(mean.rotation, Rotation.from_rotvec([p.rotation for p in many]).mean().as_matrix())
    assert np.allclose(mean.neck, Rotation.from_rotvec([p.neck for p in many]).mean().as_matrix())
    assert np.allclose(mean.translation, np.mean([p.translation for p in many], axis=0))


@given(st.integers(0, 1000))
def test_a_subject_driven_by_itself_is_unchanged(seed):
    many = poses(seed)
    mean = RigidMean.of(many)
    for pose in many:
        driven = retarget(pose, mean, mean, "target")
        assert same_turn(driven.rotation, pose.rotation)
        assert same_turn(driven.neck, pose.neck)
        assert np.allclose(driven.translation, pose.translation)
        for name in ("expression", "jaw", "eyes", "eyelids"):
            assert getattr(driven, name) is getattr(pose, name)
        assert (driven.subject, driven.timestep) == ("target", None)


def test_the_mean_of_the_source_becomes_the_mean_of_the_target():
    source, target = RigidMean.of(poses(1)), RigidMean.of(poses(2))
    turn, neck = (Rotation.from_matrix(m).as_rotvec() for m in (source.rotation, source.neck))
    rest = HeadPose("m", np.zeros(4), turn, neck, np.zeros(3), np.zeros(6), source.translation, None)
    driven = retarget(rest, source, target, "target")
    assert same_turn(driven.rotation, Rotation.from_matrix(target.rotation).as_rotvec())
    assert same_turn(driven.neck, Rotation.from_matrix(target.neck).as_rotvec())
    assert np.allclose(driven.translation, target.translation)


def test_how_the_source_capture_is_turned_does_not_matter():
    world, shift = Rotation.from_rotvec([0.4, -1.0, 2.0]), np.array([5.0, 1, -3])
    many, target = poses(3), RigidMean.of(poses(4))
    turned = [
        replace(
            p,
            rotation=(world * Rotation.from_rotvec(p.rotation)).as_rotvec(),
            translation=world.apply(p.translation) + shift,
        )
        for p in many
    ]
    for a, b in zip(many, turned):
        one, other = (retarget(p, RigidMean.of(group), target, "t") for p, group in ((a, many), (b, turned)))
        assert same_turn(one.rotation, other.rotation)
        assert np.allclose(one.translation, other.translation)
