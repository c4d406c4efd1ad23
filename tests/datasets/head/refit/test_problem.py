"""The reduced problem against the head model itself and against dense least squares."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear

from headbench.bench.contracts import HeadPose
from headbench.bench.errors import InputError
from headbench.datasets.head.model import HeadModel
from headbench.datasets.head.refit.command import RefitSettings
from headbench.datasets.head.refit.problem import SEARCHED, FitProblem
from headbench.datasets.head.rotations import matrices

from ..toy import toy_head

HEAD = toy_head(16, eyelids=True)  # correctives of every joint, root weights in the lower face
RNG = np.random.default_rng(5)
NEUTRAL = HEAD.template + HEAD.shape_basis @ RNG.normal(size=6)
VERTICES = np.union1d(
    HEAD.regions["face"], np.union1d(HEAD.regions["left_eyeball"], HEAD.regions["neck"][::3])
)
WEIGHTS = RNG.uniform(0.2, 1.0, len(VERTICES))
KEEP = RefitSettings(neck="keep")
EXPRESSION, LIDS = RNG.normal(size=8), np.array([0.3, -0.2])
ANGLES = np.array([0.3, -0.1, 0.05, 0.2, -0.3, 0.1, 0.4, 0.1, -0.2])
NECK = np.array([0.2, -0.3, 0.1])


def make(settings=KEEP, head=HEAD):
    return FitProblem(head, NEUTRAL, VERTICES, WEIGHTS, settings)


def model_in_head_frame(expression, angles, neck, lids):
    """(n, 3) by the whole head model, taken from the world to the frame of the neck joint by `head_transform`."""
    rotation, translation = np.array([0.5, -0.4, 0.7]), np.array([0.1, 0.2, 0.3])
    pose = HeadPose("toy", expression, rotation, neck, angles[:3], angles[3:], translation, eyelids=lids)
    model = HeadModel(HEAD, dtype=torch.float64)
    arguments = model.pose_arguments([pose])
    world = model(canonical=torch.from_numpy(NEUTRAL)[None], **arguments)[0].numpy()
    moving = {name: arguments[name] for name in ("expression", "rotation", "neck", "translation")}
    offset = torch.from_numpy(NEUTRAL - HEAD.template)
    motion = model.head_transform(shape=torch.zeros(6).double(), static_offset=offset, **moving)[0].numpy()
    return ((world - motion[:3, 3]) @ motion[:3, :3])[VERTICES]


def wanted(seed=0):
    return model_in_head_frame(EXPRESSION, ANGLES, NECK, LIDS) + 0.002 * np.random.default_rng(seed).normal(
        size=(len(VERTICES), 3)
    )


def test_fitted_vertices_are_the_head_models():
    """All of it: neck kept, root's weights, correctives, joints that follow the expression, eyelids."""
    problem = make()
    frame = problem.frames(wanted()[None], matrices(NECK[None]))[0]
    fitted = problem.fitted(frame, ANGLES, np.concatenate([EXPRESSION, LIDS]))
    np.testing.assert_allclose(fitted, model_in_head_frame(EXPRESSION, ANGLES, NECK, LIDS), atol=1e-14)


@pytest.mark.parametrize("bound", [6.0, 0.4])
def test_coefficients_are_those_of_dense_least_squares(bound):
    problem = make(replace(KEEP, coefficient_bound=bound, eyelid_bound=bound))
    target = wanted()
    frame = problem.frames(target[None], matrices(NECK[None]))[0]
    found = problem.evaluate(frame, ANGLES)
    root = 1e3 * np.sqrt(WEIGHTS / WEIGHTS.sum())[:, None]
    columns = (root[..., None] * problem.directions(frame, ANGLES)).reshape(3 * len(VERTICES), -1)
    rest = (root * (target - problem.fitted(frame, ANGLES, np.zeros(10)))).ravel()
    system = np.concatenate([columns, KEEP.prior_mm * np.eye(10)])
    expected = lsq_linear(system, np.append(rest, np.zeros(10)), (-bound, bound), method="bvls", tol=1e-14)
    assert (np.abs(expected.x) > 0.39).any()  # so that the smaller bound is felt
    np.testing.assert_allclose(found.coefficients, expected.x, atol=1e-6)
    assert found.value == pytest.approx(2 * expected.cost, rel=1e-8)


@pytest.mark.parametrize("settings", [KEEP, replace(KEEP, coefficient_bound=0.4), RefitSettings()], ids=str)
@pytest.mark.parametrize("angles", [ANGLES, np.zeros(9)], ids=["turned", "zero"])
def test_gradient_agrees_with_differences(settings, angles):
    problem = make(settings)
    frame = problem.frames(wanted()[None], matrices(NECK[None]))[0]
    numeric = [
        (problem.evaluate(frame, angles + s).value - problem.evaluate(frame, angles - s).value) / 2e-5
        for s in 1e-5 * np.eye(9)
    ]
    gradient = problem.evaluate(frame, angles).gradient
    expected = np.where(problem.searched, numeric, 0.0)
    assert problem.searched.tolist() == [True] * 6 + [False] * 3  # no target on the right eyeball
    np.testing.assert_allclose(gradient, expected, atol=1e-6 * np.abs(expected).max())


def test_directions_are_what_fitted_vertices_move_by():
    problem = make()
    frame = problem.frames(wanted()[None], matrices(NECK[None]))[0]
    directions = problem.directions(frame, ANGLES)
    start = problem.fitted(frame, ANGLES, np.zeros(10))
    for column, unit in enumerate(np.eye(10)):
        np.testing.assert_allclose(
            directions[..., column], problem.fitted(frame, ANGLES, unit) - start, atol=1e-15
        )


def test_another_joint_tree_is_refused():
    with pytest.raises(InputError, match="parents"):
        make(head=replace(HEAD, parents=np.array([-1, 0, 1, 2, 2])))


def test_searched_joints_are_jaw_and_eyes():
    assert SEARCHED == (2, 3, 4)
