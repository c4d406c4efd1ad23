"""``headbench run reenact`` on balls that stand where their pose says."""

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import Camera, Frame, FrameKey, HeadPose
from headbench.bench.errors import InputError
from headbench.bench.experiments.extremes import RECORD_FILE, ReenactSettings, reenact_run
from headbench.bench.experiments.reenactment import (
    NO_APPEARANCE,
    RecordedAppearance,
    RigidMean,
    RigidVertices,
    identity,
    of_recording,
    retarget,
    sample,
)
from headbench.bench.experiments.viewpoints import look_at
from headbench.bench.io.images import read_png
from headbench.datasets.head.model import HeadModel
from headbench.reports.contact_sheet import SHEET_FILE

RADIUS, SIDE = 0.1, 96
CENTER = np.array([0.02, 0.01, 0.03])


def sphere(rings=24, sectors=48):
    """Vertices and outward faces of a unit sphere."""
    polar, azimuth = np.meshgrid(
        np.linspace(0.05, np.pi - 0.05, rings), np.arange(sectors) / sectors * 2 * np.pi
    )
    points = np.stack(
        [np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)], axis=-1
    )
    index = np.arange(rings * sectors).reshape(sectors, rings)
    a, b = index[:, :-1], np.roll(index, -1, axis=0)[:, :-1]
    faces = np.concatenate([np.stack([a, a + 1, b], -1), np.stack([b, a + 1, b + 1], -1)]).reshape(-1, 3)
    return points.reshape(-1, 3), faces


class Globe:
    """A subject: a globe painted by direction. Expressions move its front, which is painted anew each time."""

    background = np.ones(3)

    def __init__(self, subject, paint):
        self.subject, self.paint = subject, paint
        points, faces = sphere()
        basis = np.zeros((len(points), 3, 1))
        basis[points[:, 2] > 0.8, 2, 0] = 0.01
        weights = np.zeros((len(points), 5))
        weights[:, 1] = 1.0
        regressor = np.zeros((5, len(points)))
        regressor[:2] = 1 / len(points)
        self.head = SimpleNamespace(
            version="globe",
            template=CENTER + RADIUS * points,
            faces=faces,
            shape_basis=np.zeros((len(points), 3, 1)),
            expression_basis=basis,
            joint_regressor=regressor,
            skinning_weights=weights,
            regions={"teeth": np.arange(30)},
        )
        self.shape, self.static_offset = np.zeros(1), np.zeros_like(points)
        K = np.array([[300.0, 0, SIDE / 2], [0, 300.0, SIDE / 2], [0, 0, 1]])
        self.camera = Camera(
            "c", SIDE, SIDE, K, look_at(np.array([0.5, 0.2, 0.6]), CENTER, np.array([0.0, 1, 0]))
        )
        self.cameras = {"c": self.camera}
        rotations = np.linspace(-0.3, 0.3, 6)
        self.poses = {t: posed(subject, [0, r, 0], (-1) ** t, t) for t, r in enumerate(rotations)}
        train = tuple(FrameKey(subject, "EMO", t, "c") for t in range(4))
        free = tuple(FrameKey(subject, "FREE", t, "c") for t in (4, 5))
        self.splits = {"train": train, "novel_view": train, "self_reenactment": free}

    def image(self, key):
        return (self.shown(self.poses[key.timestep]).rgb * 255).astype(np.uint8)

    def shown(self, pose):
        """Ray cast the globe; the paint turns with it."""
        v, u = np.mgrid[:SIDE, :SIDE] + 0.5
        rotation = self.camera.world_to_camera[:3, :3]
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(self.camera.K).T @ rotation
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        offset = self.camera.center - CENTER - pose.translation
        b = rays @ offset
        inside = b**2 - offset @ offset + RADIUS**2
        hit = offset + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
        turn = cv2.Rodrigues(pose.rotation)[0] @ cv2.Rodrigues(pose.neck)[0]
        local = hit @ turn / RADIUS
        colour = self.paint(local)
        colour = np.where(local[..., 2:] > 0.8, [pose.expression[0] / 4 + 0.5, 0.2, 0.2], colour)
        return Frame(
            np.where(inside[..., None] > 0, colour, 1.0).astype(np.float32), (inside > 0).astype(np.float32)
        )


def posed(subject, rotation, expression=0.0, timestep=None, neck=(0, 0, 0), translation=(0, 0, 0)):
    rotation, neck, translation = (np.array(a, np.float64) for a in (rotation, neck, translation))
    still = (np.zeros(3), np.zeros(6))
    return HeadPose(
        "globe", np.array([expression]), rotation, neck, *still, translation, None, subject, timestep
    )


def fair(direction):
    return 0.5 + 0.3 * direction * [0.2, 1.0, 0.5]


def dark(direction):
    return 0.3 + 0.2 * direction * [1.0, 0.2, -0.5]


@pytest.fixture(scope="module")
def globe():
    return Globe("fair", fair)


@pytest.fixture(scope="module")
def look(globe):
    return RecordedAppearance.recorded(globe, "c", 12)


def value(look, globe, pose):
    return identity(look, globe.shown(pose), globe.camera, pose).value


def test_the_parts_are_those_that_nothing_moves(globe):
    steady = RigidVertices.of(globe).indices
    assert (sphere()[0][steady, 2] <= 0.8).all()
    assert (steady >= 30).all()  # the teeth
    assert len(steady) > 500


def test_the_own_look_stays_near_whatever_pose_and_expression(globe, look):
    for rotation, neck in (
        ([0, 0, 0], [0, 0, 0]),
        ([0.1, 0.4, -0.2], [0, 0, 0]),
        ([0, 0.2, 0], [0.3, 0.1, 0]),
    ):
        pose = posed("fair", rotation, 1.7, neck=neck, translation=[0.01, 0.0, -0.02])
        assert value(look, globe, pose) < 2.0


def test_another_persons_look_is_far_for_both_subjects(globe, look):
    other = Globe("dark", dark)
    others = RecordedAppearance.recorded(other, "c", 12)
    pose = posed("fair", [0, 0.2, 0])
    own, swapped = value(look, globe, pose), value(look, other, pose)
    assert swapped > 10 > 3 * own
    assert value(others, globe, pose) > 10 > 3 * value(others, other, pose)
    assert of_recording(look, globe, globe.splits["self_reenactment"], 12) < 2.0
    assert of_recording(look, other, other.splits["self_reenactment"], 12) > 10.0


def test_what_the_camera_does_not_see_has_no_colour(globe):
    parts = RigidVertices.of(globe)
    points, normals = parts.posed(posed("fair", [0, 0, 0]))
    colours = sample(np.zeros((SIDE, SIDE, 3), np.uint8), globe.camera, points, normals)
    seen = np.isfinite(colours).all(axis=1)
    towards = globe.camera.center - points
    facing = (normals * towards).sum(axis=1) > 0
    assert seen.any()
    assert not seen[~facing].any()
    away = points + globe.camera.world_to_camera[2, :3] * -5.0  # behind the camera
    assert not np.isfinite(sample(np.zeros((SIDE, SIDE, 3), np.uint8), globe.camera, away, normals)).any()


def test_what_cannot_be_compared_has_no_value_and_says_why(globe, look):
    pose = posed("fair", [0, 0, 0])
    frame = globe.shown(pose)
    none = identity(None, frame, globe.camera, pose)
    assert (none.value, none.absent) == (None, NO_APPEARANCE)
    broken = Frame(np.full_like(frame.rgb, np.nan), frame.alpha)
    assert identity(look, broken, globe.camera, pose).absent == "not finite"
    assert RecordedAppearance.recorded(globe, "another", 12) is None


def test_steady_parts_move_as_the_head_model_moves_them(globe):
    """Against the full model: skinning of five joints, with the joints it regresses itself."""
    rng = np.random.default_rng(0)
    clip = Globe("fair", fair)
    count = len(clip.head.template)
    clip.head = SimpleNamespace(**vars(globe.head))
    clip.head.joint_regressor = rng.dirichlet(np.ones(count), size=5)
    clip.head.pose_basis = np.zeros((count, 3, 36))
    clip.head.shape_basis = rng.normal(size=(count, 3, 2)) * 0.01
    clip.head.eyelid_basis, clip.head.parents = None, np.array([-1, 0, 1, 1, 1])
    clip.shape, clip.static_offset = rng.normal(size=2), rng.normal(size=(count, 3)) * 0.001
    parts = RigidVertices.of(clip)
    pose = posed("fair", rng.normal(size=3), 0.0, neck=rng.normal(size=3), translation=rng.normal(size=3))
    names = ("expression", "rotation", "neck", "jaw", "eyes", "translation")
    values = {name: getattr(pose, name) for name in names}
    values |= {"shape": clip.shape, "static_offset": clip.static_offset}
    model = HeadModel(clip.head, dtype=torch.float64)
    vertices = model(**{name: torch.as_tensor(value)[None] for name, value in values.items()})[0].numpy()
    points, normals = parts.posed(pose)
    np.testing.assert_allclose(points, vertices[parts.indices], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)


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
