"""The canonical frame and its motion are those of the head model."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from headbench.datasets.head.model import HeadModel, PosedSubject
from headbench.methods.gha.driving import (
    Driver,
    NearestLandmarks,
    bounds,
    code_size,
    expression_codes,
    influences,
    landmark_vertices,
    mouth_box,
    training_scene,
)
from headbench.methods.gha.mesh_head import Controllers
from headbench.methods.gha.mesh_training import TrackedMotion
from headbench.methods.ops.planes import encode

from ...datasets.head.toy import toy_head
from ..toy_clip import toy_pose
from .small import small_config


def vertices(scene, code):
    """(V, 3) canonical vertices of an expression code, from the head model itself."""
    head = scene.clip.head
    model, raw = HeadModel(head), code * scene.expression_scale
    count = head.expression_basis.shape[2]
    zeros = torch.zeros(1, 3)
    posed = model(
        shape=torch.tensor(scene.clip.shape, dtype=torch.float32)[None],
        static_offset=torch.tensor(scene.clip.static_offset, dtype=torch.float32),
        expression=raw[None, :count],
        jaw=raw[None, count : count + 3],
        eyes=raw[None, count + 3 : count + 9],
        **dict.fromkeys(("rotation", "neck", "translation"), zeros),
    )[0]
    return (posed - scene.driver.origin) / scene.driver.unit


def test_moves_are_the_head_models_near_landmarks(clip):
    config = small_config(neutral_jaw=0.1, angle_unit=0.2)
    scene = training_scene(clip, config, "cpu", 0)
    motion = TrackedMotion.of(scene, config)
    opened = torch.zeros_like(scene.code_low)
    opened[clip.head.expression_basis.shape[2]] = 0.1 / 0.2
    rest = vertices(scene, opened)
    torch.testing.assert_close(scene.rest, rest, atol=1e-5, rtol=1e-5)
    landmarks = rest[torch.as_tensor(scene.landmark_rows)]
    ruled = torch.cdist(rest, landmarks).amin(1).square() <= config.near_squared
    for name in ("left_eyeball", "right_eyeball"):
        ruled[torch.as_tensor(clip.head.regions[name])] = False
    torch.testing.assert_close(motion.encoded, encode(rest[ruled]))
    for row in (0, 300, 511):
        expected = (vertices(scene, motion.codes[row]) - rest)[ruled]
        torch.testing.assert_close(motion.moves[row], expected, atol=1e-5, rtol=1e-4)


def test_a_network_learns_to_move_like_the_head_model(clip):
    """Also by expressions that no timestep shows."""
    config = small_config(zero_initialised=True, expression_deform_hidden=(32, 32), angle_unit=0.2)
    scene = training_scene(clip, config, "cpu", 0)
    motion = TrackedMotion.of(scene, config)
    network = Controllers.of(config, len(scene.code_low)).expression_deform
    initial = network.initial(torch.Generator().manual_seed(0))
    weights = motion.fitted(network, initial, 250, seed=0)
    rows = torch.as_tensor(scene.landmark_rows)
    unseen = torch.randn(5, len(scene.code_low), generator=torch.Generator().manual_seed(9))
    still = lost = 0.0
    for code in unseen:
        expected = (vertices(scene, code) - scene.rest)[rows]
        found = config.displacement_scale * torch.tanh(network(weights, encode(scene.rest[rows]), code))
        still += expected.square().sum().item()
        lost += (found - expected).square().sum().item()
    assert lost < 0.25 * still


def test_errors_count_relative_to_a_vertexs_motion(clip):
    """A network at rest errs by all the motion there is: 1, but for what hardly moves."""
    config = small_config(zero_initialised=True)
    scene = training_scene(clip, config, "cpu", 0)
    motion = TrackedMotion.of(scene, config)
    network = Controllers.of(config, len(scene.code_low)).expression_deform
    weights = network.initial(torch.Generator().manual_seed(0))
    errors = [motion.error(network, weights, torch.Generator().manual_seed(s)).item() for s in range(20)]
    squared = motion.moves.square().sum(2).mean(0)
    np.testing.assert_allclose(np.mean(errors), (squared / (squared + 4e-4)).mean(), rtol=0.05)


def test_bounds_widen_the_range_of_training():
    codes = torch.tensor([[0.0, -1.0], [2.0, 3.0], [1.0, 0.0]])
    low, high = bounds(codes, 0.25)
    torch.testing.assert_close(low, torch.tensor([-0.5, -2.0]))
    torch.testing.assert_close(high, torch.tensor([2.5, 4.0]))
    low, high = bounds(codes, None)
    assert (low < -1e38).all()
    assert (high > 1e38).all()


def test_a_margin_bounds_the_avatar_by_its_training_expressions(clip):
    margin = training_scene(clip, small_config(appearance_margin=0.5), "cpu", 0)
    count = clip.head.expression_basis.shape[2]
    seen = np.array([clip.poses[t].expression for t in margin.timesteps])
    span = seen.max(0) - seen.min(0)
    np.testing.assert_allclose(margin.code_high[:count], seen.max(0) + 0.5 * span, rtol=1e-5)


UNIT = 0.1
ORIGIN = np.array([0.01, -0.02, 0.05])


@pytest.fixture(scope="module")
def rigged():
    head = toy_head(16, eyelids=True)
    rng = np.random.default_rng(5)
    shape, offset = rng.normal(size=head.shape_basis.shape[2]), 1e-3 * rng.normal(size=head.template.shape)
    driver = Driver(head, shape, offset, ORIGIN, UNIT, None, "cpu")
    poses = [replace(toy_pose(head, rng, t, "toy"), rotation=rng.normal(size=3)) for t in range(4)]
    return head, shape, offset, driver, poses


def test_motion_is_the_head_models_rigid_motion(rigged):
    head, shape, offset, driver, poses = rigged
    expected = PosedSubject(head, shape, offset).motions(poses)
    for signal, whole in zip(driver.signals(driver.arguments(poses)), expected):
        motion = driver.motion(signal)
        np.testing.assert_allclose(motion.rotation, whole[:3, :3], atol=1e-6)
        np.testing.assert_allclose(motion.translation, whole[:3, :3] @ ORIGIN + whole[:3, 3], atol=1e-6)
        turn = Rotation.from_rotvec(motion.code[:3].numpy()).as_matrix()
        np.testing.assert_allclose(turn, whole[:3, :3], atol=1e-6)
        np.testing.assert_allclose(motion.code[3:], motion.translation)


def test_a_correction_is_added_to_the_tracked_pose(rigged):
    _, _, _, driver, poses = rigged
    change = np.array([0.1, -0.2, 0.05, 0.01, 0.02, -0.03], np.float32)
    changed = replace(
        poses[0],
        rotation=np.asarray(poses[0].rotation, np.float32) + change[:3],
        translation=np.asarray(poses[0].translation) + change[3:],
    )
    before, after = driver.signals(driver.arguments([poses[0], changed]))
    corrected, expected = driver.motion(before, torch.from_numpy(change)), driver.motion(after)
    for one, other in zip(corrected, expected):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_the_unposed_head_moves_to_the_world_by_the_motion(rigged):
    """Vertices that hang on the neck joint alone go rigidly, up to the neck's pose correctives."""
    head, _, _, driver, poses = rigged
    poses = [replace(pose, jaw=np.zeros(3), eyes=np.zeros(6), neck=np.zeros(3)) for pose in poses]
    arguments = driver.arguments(poses)
    canonical = driver.unposed(arguments)
    world = driver.model(canonical=driver.neutral[None], **arguments)
    rigid = np.flatnonzero(head.skinning_weights[:, 1] > 0.999)
    assert len(rigid) > 20
    for row, signal in enumerate(driver.signals(arguments)):
        motion = driver.motion(signal)
        placed = UNIT * canonical[row] @ motion.rotation.t() + motion.translation
        np.testing.assert_allclose(placed[rigid], world[row][rigid], atol=2e-5)


def test_the_code_holds_expression_jaw_eyes_and_eyelids(rigged):
    head, _, _, driver, poses = rigged
    pose = replace(poses[0], jaw=np.array([0.2, 0.1, 0.0]), eyelids=np.array([0.3, 0.6]))
    turned = replace(pose, jaw=pose.jaw * (1 + 2 * np.pi / np.linalg.norm(pose.jaw)))
    codes = expression_codes(driver.arguments([pose, turned])).numpy()
    expected = np.concatenate([pose.expression, pose.jaw, pose.eyes, pose.eyelids])
    assert codes.shape == (2, code_size(head)) == (2, head.expression_basis.shape[2] + 11)
    np.testing.assert_allclose(codes[0], expected, atol=1e-6)
    np.testing.assert_allclose(codes[1], expected, atol=1e-5)
    scaled = Driver(*rigged[:3], ORIGIN, UNIT, torch.full((codes.shape[1],), 0.5), "cpu")
    np.testing.assert_allclose(
        scaled.signals(driver.arguments([pose]))[0].expression, 2 * codes[0], rtol=1e-6
    )


@pytest.mark.parametrize("eyelids", [False, True])
def test_a_code_gives_back_what_it_was_made_of(eyelids):
    head = toy_head(16, eyelids=eyelids)
    size = code_size(head)
    scale = torch.linspace(0.2, 2.0, size)
    identity = np.zeros(head.shape_basis.shape[2]), np.zeros_like(head.template)
    driver = Driver(head, *identity, ORIGIN, UNIT, scale, "cpu")
    rng = np.random.default_rng(2)
    pose = toy_pose(head, rng, 0, "toy")
    if eyelids:
        pose = replace(pose, eyelids=np.array([0.3, 0.7], np.float32))
    arguments = driver.arguments([pose])
    (signal,) = driver.signals(arguments)
    back = driver.rest_arguments(signal.expression[None])
    for name in ("expression", "jaw", "eyes", *(["eyelids"] if eyelids else [])):
        torch.testing.assert_close(back[name], arguments[name], atol=1e-6, rtol=1e-5)
    assert all(not back[name].any() for name in ("rotation", "neck", "translation"))
    torch.testing.assert_close(driver.unposed(back), driver.unposed(arguments), atol=1e-5, rtol=1e-5)


def test_landmarks_are_farthest_points_of_the_face(head):
    rows = landmark_vertices(head, head.template, 30)
    assert len(np.unique(rows)) == 30
    facial = np.concatenate(
        [head.regions[n] for n in ("face", "lips", "eye_region", "nose", "left_ear", "right_ear")]
    )
    assert set(rows) <= set(facial)
    # Each is as far from those before it as any facial vertex is.
    for count in range(1, 30):
        tree = cKDTree(head.template[rows[:count]])
        reached = tree.query(head.template[rows[count]])[0]
        assert reached == pytest.approx(tree.query(head.template[facial])[0].max())
    every = landmark_vertices(head, head.template, 10_000)
    assert len(every) == len(np.unique(every)) < len(head.template)


@given(st.integers(0, 1000), st.floats(0, 0.5), st.floats(0.01, 0.5))
@settings(max_examples=30, deadline=None)
def test_influences_are_the_published_clamp(seed, near_squared, width):
    rng = np.random.default_rng(seed)
    points, landmarks = rng.normal(size=(40, 3)) * 0.6, rng.normal(size=(7, 3)) * 0.6
    far_squared = near_squared + width
    near, far = influences(torch.tensor(points), torch.tensor(landmarks), near_squared, far_squared)
    squared = cKDTree(landmarks).query(points)[0] ** 2
    expected = np.clip((far_squared - squared) / (far_squared - near_squared), 0, 1)
    weights = np.zeros((2, 40))
    for row, part in enumerate((near, far)):
        weights[row, part.rows] = part.weights
    np.testing.assert_allclose(weights[0], expected, atol=1e-9)
    np.testing.assert_allclose(weights.sum(0), 1, atol=1e-12)
    # Only where a controller has a say is it evaluated.
    assert set(near.rows.tolist()) == set(np.flatnonzero(expected > 0))
    assert set(far.rows.tolist()) == set(np.flatnonzero(expected < 1))


@pytest.mark.parametrize("landmarks", [1, 2, 30])
def test_influences_of_points_that_move_are_those_of_a_search(landmarks):
    generator = torch.Generator().manual_seed(landmarks)
    centers = 0.6 * torch.randn(landmarks, 3, generator=generator)
    points = 0.6 * torch.randn(400, 3, generator=generator)
    nearest = NearestLandmarks(centers, 0.1, 0.25)
    changed = 0
    for step in range(20):
        before = influences(points, centers, 0.1, 0.25)
        points = points + (0.2 if step == 10 else 0.01) * torch.randn(400, 3, generator=generator)
        expected = influences(points, centers, 0.1, 0.25)
        found = influences(points, centers, 0.1, 0.25, nearest(points))
        changed += sum(not torch.equal(old.rows, new.rows) for old, new in zip(before, expected))
        for one, other in zip(found, expected, strict=True):
            assert torch.equal(one.rows, other.rows)
            torch.testing.assert_close(one.weights, other.weights)
    assert changed


def test_the_mouth_box_reaches_from_the_lips_back():
    lips = np.array([[-0.3, 0.0, 0.5], [0.3, 0.1, 0.5], [0.0, -0.1, 0.9], [0.0, 0.0, 0.7]])
    center, half = mouth_box(lips)
    np.testing.assert_allclose(center, [0, 0, 0.5])
    np.testing.assert_allclose(half, [0.24, 0.08, 0.32])
