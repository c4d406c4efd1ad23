"""The step by elimination against the solution of the whole system."""

import numpy as np

from headbench.datasets.tracking.rig import PosedPoints
from headbench.datasets.tracking.solve import HeadPrior, HeadState, NormalEquations


def test_the_step_solves_the_whole_system():
    rng = np.random.default_rng(1)
    timesteps, poses, shapes, points = 3, 4, 2, 6
    state = HeadState(rng.standard_normal(shapes), rng.standard_normal((timesteps, poses)))
    prior = HeadPrior(np.array([np.inf, 0.5, 1.0, 2.0]), np.array([0.3, 3.0]))
    equations = NormalEquations(timesteps, poses, shapes)
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


def test_a_prior_of_0_keeps_a_parameter():
    rng = np.random.default_rng(2)
    equations = NormalEquations(1, 2, 1)
    posed = PosedPoints(*(rng.standard_normal(size) for size in ((4, 3), (4, 3, 2), (4, 3, 1))))
    equations.add(0, posed, np.tile(np.eye(3), (4, 1, 1)), rng.standard_normal((4, 3)))
    state = HeadState(np.array([0.7]), np.array([[0.2, 0.3]]))
    found = equations.step(state, HeadPrior(np.array([np.inf, 0.0]), np.zeros(1)))
    assert found.shape[0] == 0.7
    assert found.poses[0, 1] == 0.3
    assert found.poses[0, 0] != 0.2
