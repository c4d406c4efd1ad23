"""The step by elimination against the solution of the whole system."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from headbench.datasets.head.model import HeadModel
from headbench.datasets.tracking.equations import (
    HeadPrior,
    HeadState,
    MotionPrior,
    NormalEquations,
    continuous,
)
from headbench.datasets.tracking.rig import ANGLES, PointRig, PoseColumns, PosedPoints

from ..head.toy import toy_head


def drawn(head, seed=3):
    rng = np.random.default_rng(seed)
    pose = 0.4 * rng.standard_normal(PoseColumns.of(head).size)
    return rng, pose, rng.standard_normal(head.shape_basis.shape[2])


def vertices_of(head, pose, shape):
    """Vertices by the head model, differentiable."""
    columns = PoseColumns.of(head)
    lids = columns.size - columns.eyelid_size
    parts = {"expression": pose[ANGLES + 3 : lids], "rotation": pose[:3], "neck": pose[3:6], "jaw": pose[6:9]}
    parts |= {"eyes": pose[9:15], "translation": pose[15:18]}
    parts |= {"eyelids": pose[lids:]} if columns.eyelid_size else {}
    return HeadModel(head, dtype=torch.float64)(shape=shape, **parts)[0]


@pytest.mark.parametrize("eyelids", [False, True])
def test_derivatives_are_those_of_the_head_model(eyelids):
    head = toy_head(16, eyelids=eyelids)
    rng, pose, shape = drawn(head)
    vertices = rng.choice(len(head.template), 40, replace=False)
    found = PointRig.at_vertices(head, vertices).linearised(shape, pose)
    given = torch.tensor(pose), torch.tensor(shape)
    chosen = torch.tensor(vertices)
    by_pose, by_shape = torch.autograd.functional.jacobian(
        lambda p, s: vertices_of(head, p, s)[chosen], given
    )
    np.testing.assert_allclose(found.points, vertices_of(head, *given)[chosen], atol=1e-6)
    np.testing.assert_allclose(found.by_pose, by_pose, atol=1e-6)
    np.testing.assert_allclose(found.by_shape, by_shape, atol=1e-6)


def test_points_without_derivatives_are_the_same():
    head = toy_head(16, eyelids=True)
    _, pose, shape = drawn(head)
    rig = PointRig.at_vertices(head, np.arange(30))
    np.testing.assert_allclose(rig.points(shape, pose), rig.linearised(shape, pose).points, atol=1e-6)


def test_poses_keep_the_columns():
    head = toy_head(16, eyelids=True)
    _, pose, shape = drawn(head)
    (made,) = PoseColumns.of(head).poses(pose[None], head, "someone", [7])
    wanted = vertices_of(head, torch.tensor(pose), torch.tensor(shape))
    np.testing.assert_allclose(head(made, shape), wanted, atol=1e-6)
    assert (made.timestep, made.subject) == (7, "someone")
    np.testing.assert_allclose(PoseColumns.of(head).rows([made])[0], pose, atol=1e-6)


def test_the_step_solves_the_whole_system():
    rng = np.random.default_rng(1)
    timesteps, poses, shapes, points = 3, 4, 2, 6
    state = HeadState(rng.standard_normal(shapes), rng.standard_normal((timesteps, poses)))
    prior = HeadPrior(np.array([np.inf, 0.5, 1.0, 2.0]), np.array([0.3, 3.0]))
    equations = NormalEquations(state)
    size = timesteps * poses + shapes
    whole, right = np.zeros((size, size)), np.zeros(size)
    for row in range(timesteps):
        root = rng.standard_normal((points, 3, 3))
        slope = rng.standard_normal((points, 3))
        posed = PosedPoints(
            rng.standard_normal((points, 3)),
            rng.standard_normal((points, 3, poses)),
            rng.standard_normal((points, 3, shapes)),
        )
        curvature = root @ root.transpose(0, 2, 1)
        equations.add(row, posed, curvature, slope)
        dense = np.zeros((points, 3, size))
        dense[:, :, row * poses : (row + 1) * poses] = posed.by_pose
        dense[:, :, timesteps * poses :] = posed.by_shape
        whole += np.einsum("pia,pij,pjb->ab", dense, curvature, dense)
        right += np.einsum("pia,pi->a", dense, slope)
    stiff = np.concatenate([*[1 / prior.pose**2] * timesteps, 1 / prior.shape**2])
    values = np.concatenate([state.poses.ravel(), state.shape])
    wanted = values + np.linalg.solve(whole + np.diag(stiff), right - stiff * values)
    found = equations.step(state, prior, damping=0.0)
    np.testing.assert_allclose(np.concatenate([found.poses.ravel(), found.shape]), wanted, atol=1e-6)


def test_linked_poses_solve_the_whole_system():
    rng = np.random.default_rng(3)
    timesteps, poses, points = 5, 4, 6
    state = HeadState(np.zeros(0), rng.standard_normal((timesteps, poses)))
    prior = HeadPrior(np.array([np.inf, 0.5, 1.0, 2.0]), np.zeros(0))
    equations = NormalEquations(state)
    size = timesteps * poses
    whole, right = np.zeros((size, size)), np.zeros(size)
    for row in range(timesteps):
        place = slice(row * poses, (row + 1) * poses)
        jacobian, weight = rng.standard_normal((points, poses)), rng.uniform(1, 2, points)
        residual = rng.standard_normal(points)
        equations.add_residuals(row, jacobian, weight, residual)
        whole[place, place] += jacobian.T * weight @ jacobian
        right[place] += jacobian.T @ (weight * residual)
    motion = MotionPrior(rng.standard_normal(poses), rng.uniform(0.1, 1.0, (timesteps, poses)))
    motion.deviations[3] = np.inf
    equations.link(state.poses, motion)
    difference = np.eye(size) - np.eye(size, k=-poses)  # from the pose before
    stiff = np.concatenate([1 / prior.pose**2] * timesteps)
    pull = difference.T * motion.deviations.ravel() ** -2.0
    values = state.poses.ravel()
    known = np.concatenate([motion.before, np.zeros(size - poses)])
    wanted = right - pull @ (difference @ values - known) - stiff * values
    change = np.linalg.solve(whole + pull @ difference + np.diag(stiff), wanted)
    found = equations.step(state, prior, damping=0.0)
    np.testing.assert_allclose(found.poses.ravel(), values + change, atol=1e-6)


def test_rotation_vectors_are_continuous_at_half_a_turn():
    angles = np.linspace(np.pi - 0.3, np.pi + 0.3, 7)
    turned = Rotation.from_rotvec(angles[:, None] * [1.0, 0.0, 0.0])
    poses = np.concatenate([turned.as_rotvec(), np.ones((7, 2))], axis=1)
    assert np.abs(np.diff(poses[:, 0])).max() > 3
    found = continuous(poses)
    np.testing.assert_allclose(found[:, 0], angles, atol=1e-9)
    np.testing.assert_array_equal(found[:, 3:], poses[:, 3:])


def test_a_prior_of_0_keeps_a_parameter():
    rng = np.random.default_rng(2)
    state = HeadState(np.array([0.7]), np.array([[0.2, 0.3]]))
    equations = NormalEquations(state)
    posed = PosedPoints(*(rng.standard_normal(size) for size in ((4, 3), (4, 3, 2), (4, 3, 1))))
    equations.add(0, posed, np.tile(np.eye(3), (4, 1, 1)), rng.standard_normal((4, 3)))
    found = equations.step(state, HeadPrior(np.array([np.inf, 0.0]), np.zeros(1)))
    assert found.shape[0] == 0.7
    assert found.poses[0, 1] == 0.3
    assert found.poses[0, 0] != 0.2
