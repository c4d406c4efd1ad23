"""Identity on painted globes: colours at tracked vertices, whatever the pose; other people's look is further away."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from headbench.bench.contracts import Camera, Frame, FrameKey, HeadPose
from headbench.bench.experiments.reenactment import (
    NO_APPEARANCE,
    RecordedAppearance,
    RigidVertices,
    identity,
    of_recording,
    sample,
)
from headbench.bench.experiments.viewpoints import look_at
from headbench.datasets.head.model import HeadModel

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
