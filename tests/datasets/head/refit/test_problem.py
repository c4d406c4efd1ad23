"""The reduced problem against the head model itself and against dense least squares."""

from dataclasses import replace

import nlopt
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares, lsq_linear
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import HeadPose
from headbench.datasets.head.model import HeadModel
from headbench.datasets.head.refit.problem import FitProblem, angle_bounds, solve_bounded, solve_frame
from headbench.datasets.head.refit.settings import RefitSettings

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
TURN = Rotation.from_rotvec(NECK[None]).as_matrix()


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
    frame = problem.frames(wanted()[None], TURN)[0]
    fitted = problem.fitted(frame, ANGLES, np.concatenate([EXPRESSION, LIDS]))
    np.testing.assert_allclose(fitted, model_in_head_frame(EXPRESSION, ANGLES, NECK, LIDS), atol=1e-14)


@pytest.mark.parametrize("bound", [6.0, 0.4])
def test_coefficients_are_those_of_dense_least_squares(bound):
    problem = make(replace(KEEP, coefficient_bound=bound, eyelid_bound=bound))
    target = wanted()
    frame = problem.frames(target[None], TURN)[0]
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
    frame = problem.frames(wanted()[None], TURN)[0]
    numeric = [
        (problem.evaluate(frame, angles + s).value - problem.evaluate(frame, angles - s).value) / 2e-5
        for s in 1e-5 * np.eye(9)
    ]
    gradient = problem.evaluate(frame, angles).gradient
    expected = np.where(problem.searched, numeric, 0.0)
    assert problem.searched.tolist() == [True] * 6 + [False] * 3  # no target on the right eyeball
    np.testing.assert_allclose(gradient, expected, atol=1e-6 * np.abs(expected).max())


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12), st.floats(0.01, 3.0))
def test_agrees_with_scipy(seed, size, bound):
    rng = np.random.default_rng(seed)
    matrix, wanted = rng.normal(size=(size + 5, size)), rng.normal(size=size + 5)
    limits = bound * rng.uniform(0.2, 1.0, size)
    found = solve_bounded(matrix.T @ matrix, matrix.T @ wanted, limits)
    expected = lsq_linear(matrix, wanted, (-limits, limits), method="bvls", tol=1e-14).x
    assert (np.abs(found) <= limits).all()
    np.testing.assert_allclose(found, expected, atol=1e-6)


STILL = np.eye(3)[None]
EXACT = np.concatenate([EXPRESSION, LIDS])


def reachable(problem, angles=ANGLES, coefficients=EXACT):
    """A target that the problem can meet."""
    frame = problem.frames(wanted()[None], TURN)[0]
    points = problem.fitted(frame, angles, coefficients)
    return points, problem.frames(points[None], TURN)[0]


@pytest.mark.parametrize("algorithm", ["slsqp", "lbfgs", "mma"])
def test_every_algorithm_finds_what_made_the_target(algorithm):
    settings = RefitSettings(neck="keep", algorithm=algorithm, prior_mm=1e-5, evaluations=500)
    problem = make(settings)
    points, frame = reachable(problem)
    found = solve_frame(problem, frame, np.zeros(9), ANGLES, settings)
    np.testing.assert_allclose(found.angles, ANGLES, atol=2e-4)
    gap = np.linalg.norm(problem.fitted(frame, found.angles, found.coefficients) - points, axis=1)
    assert gap.max() < 2e-5
    assert 1 < found.evaluations <= 500


def solve_dense(problem, frame, wanted, weights, start, settings):
    """(9 + E + L,) angles and coefficients by `scipy.optimize.least_squares` on all residuals.

    Its Jacobian is exact in the coefficients and taken by differences in the nine angles.
    """
    root = np.sqrt(weights / weights.sum())[:, None] * 1e3
    size = len(problem.bound)
    prior = settings.prior_mm * np.eye(size)

    def residuals(values):
        gaps = root * (problem.fitted(frame, values[:9], values[9:]) - wanted)
        return np.concatenate([gaps.ravel(), settings.prior_mm * values[9:]])

    def jacobian(values):
        columns = root[..., None] * problem.directions(frame, values[:9])
        rows = np.concatenate([columns.reshape(-1, size), prior])
        steps = 1e-6 * np.eye(len(values))[:9]
        angles = [(residuals(values + step) - residuals(values - step)) / 2e-6 for step in steps]
        return np.column_stack([*angles, rows])

    bound = np.concatenate([angle_bounds(settings), problem.bound])
    first = np.concatenate([start.angles, start.coefficients])
    first = np.clip(first, -0.999 * bound, 0.999 * bound)
    found = least_squares(residuals, first, jacobian, bounds=(-bound, bound), x_scale="jac")
    return found.x


def test_agrees_with_scipy_on_a_target_out_of_reach():
    """Noise of 2 mm on targets of face and both eyeballs; scipy works on all residuals and all unknowns."""
    settings = RefitSettings()
    regions = [HEAD.regions[name] for name in ("face", "left_eyeball", "right_eyeball")]
    vertices = np.unique(np.concatenate(regions))
    weights = np.ones(len(vertices))
    problem = FitProblem(HEAD, NEUTRAL, vertices, weights, settings)
    easy = problem.frames(NEUTRAL[vertices][None], STILL)[0]
    noise = 0.002 * np.random.default_rng(1).normal(size=(len(vertices), 3))
    target = problem.fitted(easy, ANGLES, EXACT) + noise
    frame = problem.frames(target[None], STILL)[0]
    start = solve_frame(problem, frame, np.zeros(9), np.zeros(9), replace(settings, evaluations=2))
    ours = solve_frame(problem, frame, np.zeros(9), np.zeros(9), replace(settings, tolerance=1e-7))
    theirs = solve_dense(problem, frame, target, weights, start, settings)
    assert ours.value == pytest.approx(problem.evaluate(frame, theirs[:9]).value, rel=1e-6)
    np.testing.assert_allclose(ours.angles, theirs[:9], atol=1e-3)
    np.testing.assert_allclose(ours.coefficients, theirs[9:], atol=1e-3)


def test_angles_stay_in_their_bounds_and_reach_them():
    settings = RefitSettings(neck="keep", jaw_bound=0.2, eye_bound=0.25)
    problem = make(settings)
    _, frame = reachable(problem)
    found = solve_frame(problem, frame, np.full(9, 5.0), 0.9 * ANGLES, settings)
    assert (np.abs(found.angles[:6]) <= angle_bounds(settings)[:6] + 1e-15).all()
    assert found.angles[0] == pytest.approx(0.2)
    np.testing.assert_array_equal(found.angles[6:], 0.9 * ANGLES[6:])  # no target: they keep their values
    problem.searched[:] = False
    still = solve_frame(problem, frame, np.zeros(9), ANGLES, settings)
    assert still.evaluations == 1
    np.testing.assert_array_equal(still.angles, ANGLES)


@pytest.mark.parametrize("failure", [nlopt.runtime_error, nlopt.RoundoffLimited])
def test_a_line_search_that_gives_up_leaves_the_best_point(failure, monkeypatch):
    """nlopt reports it as a failure of the whole search, which would end the refit of a whole clip."""
    settings = RefitSettings(neck="keep", algorithm="lbfgs")
    problem = make(settings)
    _, frame = reachable(problem)
    whole = solve_frame(problem, frame, np.zeros(9), ANGLES, settings)
    search = nlopt.opt.optimize

    def give_up(self, start):
        search(self, start)
        raise failure("nlopt failure")

    monkeypatch.setattr(nlopt.opt, "optimize", give_up)
    found = solve_frame(problem, frame, np.zeros(9), ANGLES, settings)
    assert found.value == whole.value
    np.testing.assert_array_equal(found.angles, whole.angles)
