"""Components of expressions against scikit-learn; poses to try against what they are said to be."""

from types import SimpleNamespace

import numpy as np
import pytest
from sklearn.decomposition import PCA

from headbench.bench.contracts import FrameKey, HeadPose
from headbench.reports.robustness.extremes import ExpressionComponents, extremes, typical_pose


@pytest.fixture
def coefficients():
    rng = np.random.default_rng(3)
    return rng.normal(size=(40, 12)) @ rng.normal(size=(12, 12)) + rng.normal(size=12)


def clip_of(coefficients, held_out=None):
    zero = np.zeros(3)
    rows = coefficients if held_out is None else np.vstack([coefficients, held_out])
    poses = {
        t: HeadPose(
            "m", row.astype(np.float32), zero + t, zero, zero + 2 * t, np.zeros(6), zero, None, "s", t
        )
        for t, row in enumerate(rows)
    }
    keys = tuple(FrameKey("s", "EMO", t, c) for t in range(len(coefficients)) for c in "ab")
    return SimpleNamespace(subject="s", poses=poses, splits={"train": keys})


def test_components_are_those_of_scikit_learn(coefficients):
    ours, theirs = ExpressionComponents.of(coefficients, 5), PCA(5).fit(coefficients)
    assert np.allclose(ours.mean, theirs.mean_)
    assert np.allclose(ours.deviations**2, theirs.explained_variance_)
    assert np.allclose(np.abs((ours.directions * theirs.components_).sum(axis=1)), 1.0)
    step = ours.at(2, -3.0) - theirs.mean_
    assert np.allclose(theirs.transform([ours.at(2, -3.0)])[0][[0, 1, 3, 4]], 0, atol=1e-9)
    assert np.isclose(np.linalg.norm(step), 3 * np.sqrt(theirs.explained_variance_[2]))


def test_directions_without_variation_are_left_out(coefficients):
    flat = coefficients.copy()
    flat[:, 3:] = 1.5
    assert len(ExpressionComponents.of(flat, 8).deviations) == 3
    assert len(ExpressionComponents.of(np.full((5, 4), 0.3), 8).deviations) == 0


def test_every_step_along_every_component_after_the_mean(coefficients):
    found = extremes(clip_of(coefficients), 2, (-3.0, 1.0))
    assert [e.name for e in found] == ["mean", "pc1-3", "pc1+1", "pc2-3", "pc2+1"]
    assert np.allclose(found[0].pose.expression, coefficients.mean(axis=0), atol=1e-5)
    assert all(e.pose.timestep is None and e.pose.expression.dtype == np.float32 for e in found)
    assert len({e.pose.rotation.tobytes() for e in found}) == 1


def test_held_out_expressions_have_no_say(coefficients):
    with_others = clip_of(coefficients, held_out=100 * np.ones((9, 12)))
    for a, b in zip(extremes(clip_of(coefficients), 8, (3.0,)), extremes(with_others, 8, (3.0,))):
        assert np.array_equal(a.pose.expression, b.pose.expression)


def test_the_typical_pose_is_a_real_one(coefficients):
    poses = list(clip_of(coefficients).poses.values())
    distances = np.linalg.norm(coefficients - coefficients.mean(axis=0), axis=1)
    assert typical_pose(poses) is poses[int(distances.argmin())]
