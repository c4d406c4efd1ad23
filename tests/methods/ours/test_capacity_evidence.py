"""What training data say of the capacity needed, against displacements computed the long way."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.datasets.steps.jaw_bases import IDENTITY, farthest_quaternions, jaw_quaternions, jaw_weights
from headbench.methods.ours.capacity import jaw_lever, largest_displacements, spanning_jaw_bases
from headbench.methods.shared.capacity import displacement_without, leading_directions, pixel_footprint
from headbench.methods.shared.subject_mesh import SubjectMesh

from ..toy_clip import toy_clip, toy_pose


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
