"""The search for angles: it finds what made the target, by every algorithm, and stays in bounds."""

from dataclasses import replace

import nlopt
import numpy as np
import pytest

from headbench.datasets.head.refit.command import RefitSettings
from headbench.datasets.head.refit.problem import FitProblem, angle_bounds, solve_frame
from headbench.datasets.head.rotations import matrices
from headbench.tests.benchmarks.refit import solve_dense

from .test_problem import ANGLES, EXPRESSION, HEAD, LIDS, NECK, NEUTRAL, make, wanted

STILL = matrices(np.zeros((1, 3)))
EXACT = np.concatenate([EXPRESSION, LIDS])


def reachable(problem, angles=ANGLES, coefficients=EXACT):
    """A target that the problem can meet."""
    frame = problem.frames(wanted()[None], matrices(NECK[None]))[0]
    points = problem.fitted(frame, angles, coefficients)
    return points, problem.frames(points[None], matrices(NECK[None]))[0]


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
    found = solve_frame(problem, frame, np.full(9, 5.0), np.zeros(9), settings)
    assert (np.abs(found.angles) <= angle_bounds(settings) + 1e-15).all()
    assert found.angles[0] == pytest.approx(0.2)
    assert np.isfinite(found.value)


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


def test_angles_without_targets_keep_their_values():
    settings = RefitSettings(neck="keep")
    problem = make(settings)
    _, frame = reachable(problem)
    found = solve_frame(problem, frame, np.zeros(9), ANGLES, settings)
    np.testing.assert_array_equal(found.angles[6:], ANGLES[6:])


def test_nothing_to_search_is_one_evaluation():
    settings = RefitSettings()
    problem = make(settings)
    _, frame = reachable(problem)
    problem.searched[:] = False
    found = solve_frame(problem, frame, np.zeros(9), ANGLES, settings)
    assert found.evaluations == 1
    np.testing.assert_array_equal(found.angles, ANGLES)
