"""Capacity plans of toy clips: what is not there costs nothing, and what is planned trains."""

import json
import logging
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine.scoring import TrainingView
from headbench.bench.engine.stored import TRAINING_FILE
from headbench.datasets.steps.clusters import IDENTITY, farthest_quaternions, jaw_quaternions, jaw_weights
from headbench.methods.ours.method import (
    Ours,
    jaw_lever,
    largest_displacements,
    plan_capacity,
    spanning_jaw_bases,
)
from headbench.methods.ours.spec import Lines, OursConfig, Penalty, PlannedCapacity
from headbench.methods.shared.avatar_files import clip_mesh
from headbench.methods.shared.capacity import displacement_without, leading_directions, pixel_footprint
from headbench.methods.shared.config import SplatTraining
from headbench.methods.shared.surface_points import SubjectMesh

from ..toy_clip import toy_clip, toy_pose
from .toy import changed


def random_expressions(seed, timesteps=70, size=9):
    rng = np.random.default_rng(seed)
    strength = rng.uniform(0, 1, size) ** 4
    coefficients = rng.normal(size=(timesteps, size)) * strength + rng.normal(size=size)
    return coefficients, rng.normal(size=(11, 3, size))


def left_out(coefficients, basis, kept):
    """Float64, all at once."""
    deviation = coefficients - coefficients.mean(0)
    fields = np.einsum("te,vce->tvc", deviation[:, kept:], basis[:, :, kept:])
    return np.linalg.norm(fields, axis=2).max()


@given(st.integers(0, 2**32 - 1), st.floats(0.02, 5))
def test_leading_directions_are_the_fewest_within_the_tolerance(seed, tolerance):
    coefficients, basis = random_expressions(seed)
    kept = leading_directions(coefficients, basis, tolerance)
    for count in range(kept, basis.shape[2] + 1):
        assert left_out(coefficients, basis, count) <= tolerance * (1 + 1e-5)
    assert kept == 0 or left_out(coefficients, basis, kept - 1) > tolerance * (1 - 1e-5)
    found = displacement_without(coefficients, basis, kept)
    np.testing.assert_allclose(found, left_out(coefficients, basis, kept), rtol=1e-4, atol=1e-5)


def jaws(head, *angles):
    pose = toy_pose(head, np.random.default_rng(0), 0, "toy")
    return [replace(pose, jaw=np.array(angle, dtype=np.float64)) for angle in angles]


def test_an_opening_jaw_needs_two_bases_and_a_resting_one_none(head):
    opening = jaws(head, *([x, 0, 0] for x in np.linspace(0, 0.4, 12)))
    assert spanning_jaw_bases(opening, 16, 0.1, 1e-5)[0] == 2
    still = jaws(head, *[[0.2, 0.1, 0]] * 5)
    assert spanning_jaw_bases(still, 16, 0.1, 1e-5) == (0, pytest.approx(0, abs=1e-9))
    every = jaws(head, *np.random.default_rng(1).uniform(-0.3, 0.3, (40, 3)))
    assert spanning_jaw_bases(every, 16, 0.1, 1e-5)[0] == 4
    assert spanning_jaw_bases(every, 3, 0.1, 1e-5)[0] == 3


def test_lines_of_the_bases_kept_can_say_what_all_sixteen_say(head):
    """The claim behind `spanning_jaw_bases`: up to a scale common to a frame, by least squares over the frames."""
    poses = jaws(head, *(np.random.default_rng(2).uniform(-0.3, 0.3, (60, 3)) * [1, 0.3, 0]))
    quaternions = jaw_quaternions(poses)
    count, _ = spanning_jaw_bases(poses, 16, 0.1, 1e-9)
    assert count < 16
    every = farthest_quaternions(quaternions, IDENTITY, 16)
    full, few = jaw_weights(quaternions, every), jaw_weights(quaternions, every[:count])
    # Undo the common scale of a frame, which the weights' sum to one hides.
    full = full * np.abs(quaternions @ every.T).sum(1, keepdims=True)
    few = few * np.abs(quaternions @ every[:count].T).sum(1, keepdims=True)
    solution = np.linalg.lstsq(few, full, rcond=None)[0]
    np.testing.assert_allclose(few @ solution, full, atol=1e-9)
    fewer = np.linalg.lstsq(few[:, :-1], full, rcond=None)[0]
    assert np.abs(few[:, :-1] @ fewer - full).max() > 1e-6


@given(st.integers(0, 2**32 - 1), st.floats(1e-6, 0.05))
def test_the_residual_rotation_moves_no_vertex_further_than_said(seed, tolerance):
    rng = np.random.default_rng(seed)
    rotations = rng.uniform(-0.4, 0.4, (20, 3)) * [1, 0.2, 0.05]
    poses: list[Any] = [SimpleNamespace(jaw=rotation) for rotation in rotations]
    lever = 0.1
    count, rest = spanning_jaw_bases(poses, 16, lever, tolerance)
    quaternions = jaw_quaternions(poses)
    farthest = farthest_quaternions(quaternions, IDENTITY, 16)
    spanning = farthest[:count] if count else quaternions.mean(0)[None]
    assert rest <= tolerance or count == 16
    nearest = quaternions @ np.linalg.pinv(spanning) @ spanning
    nearest /= np.linalg.norm(nearest, axis=1, keepdims=True)
    there, near = (Rotation.from_quat(values[:, [1, 2, 3, 0]]) for values in (quaternions, nearest))
    moved = (2 * lever * np.sin((there * near.inv()).magnitude() / 2)).max()
    assert moved <= rest * 1.1 + 1e-12


def test_lever_bounds_what_the_jaw_moves(head):
    mesh = SubjectMesh(head, np.zeros(head.shape_basis.shape[2]), np.zeros_like(head.template), "cpu")
    angle = 0.3
    still = jaws(head, [0, 0, 0])[0]
    still = replace(still, expression=np.zeros_like(still.expression), eyes=np.zeros(6))
    opened = replace(still, jaw=np.array([angle, 0, 0]))
    one, other = (mesh.unposed(mesh.arguments([pose])) for pose in (still, opened))
    moved = float((one - other).norm(dim=1).max())
    bound = 2 * jaw_lever(mesh) * np.sin(angle / 2)
    assert 0.5 * bound < moved <= 1.25 * bound


def test_largest_displacements_are_those_of_the_moving_pose(head):
    mesh = SubjectMesh(head, np.zeros(head.shape_basis.shape[2]), np.zeros_like(head.template), "cpu")
    pose = jaws(head, [0.2, 0, 0])[0]
    rest = replace(pose, expression=0 * pose.expression, jaw=np.zeros(3), eyes=np.zeros(6))
    assert largest_displacements(mesh, [rest]).max() < 1e-7
    both = largest_displacements(mesh, [pose, rest])
    vertices = mesh.unposed(mesh.arguments([pose])).numpy()
    expected = np.linalg.norm((vertices - mesh.canonical.numpy())[head.faces].mean(1), axis=1)
    np.testing.assert_allclose(both, expected, atol=1e-7)


def test_footprint_is_depth_over_focal_length(head):
    clip = toy_clip(head, timesteps=2, cameras=3, width=20, height=24)
    focal = 0.5 * 24 / np.tan(np.radians(20))
    np.testing.assert_allclose(pixel_footprint(clip, np.zeros(3)), 0.5 / focal, rtol=0.02)


SMALL = OursConfig(
    splats=SplatTraining(max_splats=2000, min_densify_every=40, min_settle=20),
    hidden=16,
    lines=Lines(resolution=8, channels=4, bounds="head"),
    penalty=Penalty(face_mm=0.1, other_mm=0.2),
    capacity=PlannedCapacity(mode="auto"),
)
MEGAPIXEL = 40
"""Enlarges the toy's cameras so that its millimetres are pixels."""


def plan(clip, config=SMALL):
    return plan_capacity(clip, clip_mesh(clip, "cpu"), config)


def chosen(clip, config=SMALL):
    return {each.name: each.chosen for each in plan(clip, config).decisions}


def with_poses(clip, change):
    return replace(clip, poses={t: replace(pose, **change(pose)) for t, pose in clip.poses.items()})


def enlarged(clip, factor):
    cameras = {name: c.resized(factor * c.width, factor * c.height) for name, c in clip.cameras.items()}
    return replace(clip, cameras=cameras)


@pytest.fixture(scope="module")
def sharp(clip):
    return enlarged(clip, MEGAPIXEL)


def still(pose):
    return {"expression": 0 * pose.expression, "jaw": np.zeros(3), "eyes": np.zeros(6)}


def test_all_of_an_expressive_sharp_clip_is_modelled(sharp):
    sizes = chosen(sharp)
    assert sizes["lines.expressions"] == sharp.head.expression_basis.shape[2]
    assert sizes["lines.jaw_bases"] == 2
    assert sizes["planes.resolution"] == SMALL.planes.resolution
    assert sizes["splats.max_splats"] == SMALL.splats.max_splats
    assert plan(sharp).lines


def leading(pose):
    return {"expression": np.where(np.arange(len(pose.expression)) < 3, pose.expression, 0.4)}


@pytest.mark.parametrize(
    ("change", "expressions", "jaw_bases"),
    [
        (still, 0, 0),
        (lambda pose: {"jaw": np.zeros(3)}, None, 0),
        (lambda pose: {"expression": 0 * pose.expression}, 0, 2),
        (leading, 3, 2),
    ],
    ids=["still", "jaw still", "jaw alone", "three directions"],
)
def test_only_what_moves_is_modelled(sharp, change, expressions, jaw_bases):
    found = plan(with_poses(sharp, change))
    sizes = {each.name: each.chosen for each in found.decisions}
    assert sizes["lines.jaw_bases"] == jaw_bases
    assert sizes["lines.expressions"] == expressions or (
        expressions is None and sizes["lines.expressions"] > 0
    )
    assert found.lines == found.apply(SMALL).lines.enabled == (expressions != 0 or jaw_bases > 0)
    assert found.lines or found.lines_within is None


def test_lines_reach_no_further_than_what_moves(sharp):
    found = plan(sharp)
    low, high = map(np.array, found.lines_within)
    canonical = clip_mesh(sharp, "cpu").canonical.numpy()
    assert (low >= canonical.min(0) - 1e-7).all()
    assert (high <= canonical.max(0) + 1e-7).all()
    strict = plan(sharp, changed(SMALL, penalty={"face_mm": 6.0, "other_mm": 6.0}))
    smaller = np.prod(np.subtract(*strict.lines_within[::-1]))
    assert 0 < smaller < np.prod(high - low)


def test_doubling_the_images_raises_planes_and_splats(clip):
    config = changed(SMALL, splats=SplatTraining(), planes={"resolution": 1000})
    once, twice = (chosen(enlarged(clip, factor), config) for factor in (4, 8))
    assert once["planes.resolution"] < twice["planes.resolution"] <= 2 * once["planes.resolution"]
    assert once["splats.max_splats"] <= twice["splats.max_splats"]
    assert chosen(clip)["planes.resolution"] < 40


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(0.05, 50), st.floats(1, 10))
def test_more_tolerance_never_asks_for_more(sharp, tolerance, factor):
    fine, coarse = (chosen(sharp, changed(SMALL, capacity={"tolerance": tolerance * f})) for f in (1, factor))
    for name in ("lines.expressions", "lines.jaw_bases", "planes.resolution", "splats.max_splats"):
        assert coarse[name] <= fine[name]


def test_configured_sizes_are_limits_and_can_be_kept(sharp, clip):
    config = changed(SMALL, lines={"expressions": 2, "jaw_bases": 1}, planes={"resolution": 9})
    sizes = chosen(sharp, config)
    names = ("lines.expressions", "lines.jaw_bases", "planes.resolution")
    assert [sizes[name] for name in names] == [2, 1, 9]
    kept = changed(SMALL, capacity={"keep": ("lines.expressions", "planes.resolution", "lines.bounds")})
    found = plan(with_poses(clip, still), kept)
    resolved = found.apply(kept)
    assert (resolved.lines.expressions, resolved.planes.resolution) == (80, 128)
    assert resolved.lines
    assert found.lines_within is None


def test_held_out_poses_decide_nothing(clip):
    def other(t, pose):
        if t not in {key.timestep for key in clip.splits["self_reenactment"]}:
            return pose
        return replace(pose, expression=50 * pose.expression, jaw=-3 * pose.jaw)

    poses = {t: other(t, pose) for t, pose in clip.poses.items()}
    changed_elsewhere = replace(clip, poses=poses)
    assert plan(TrainingView(changed_elsewhere)) == plan(clip)


@pytest.mark.parametrize("change", ["expressive", "still"])
def test_a_planned_avatar_trains_renders_and_keeps_its_plan(clip, tmp_path, caplog, change):
    if change == "still":
        clip = with_poses(clip, still)
    config = changed(SMALL, capacity={"tolerance": 0.02})
    options = {"device": "cpu", "seed": 0, "progress": no_progress}
    with caplog.at_level(logging.INFO, "headbench"):
        avatar = Ours(config).fit(clip, tmp_path, Budget(iterations=30), **options)
    key = clip.splits["train"][0]
    image = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep]).rgb
    truth = clip.image(key) / 255
    assert np.abs(image - truth).mean() < np.abs(1 - truth).mean()
    (line,) = (text for text in caplog.messages if "capacity" in text)
    assert "planes.resolution" in line
    assert "\n" not in line
    assert len(line) < 400
    record = json.loads((tmp_path / TRAINING_FILE).read_text())["capacity"]
    assert record["lines"] == (change == "expressive")
    planned = {each["name"]: each for each in record["decisions"]}
    assert len(avatar.field.tensors["plane_xy"]) == planned["planes.resolution"]["chosen"] ** 2
    assert planned["planes.resolution"]["numbers"]["longest_px"] > 0
    again = Ours(config).fit(clip, tmp_path, Budget(iterations=30), **options)
    np.testing.assert_array_equal(again.render(clip.cameras[key.camera], clip.poses[key.timestep]).rgb, image)
