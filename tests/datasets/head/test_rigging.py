"""Rig fitting on motions whose answer is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.datasets.head.ict import (
    Hinge,
    fit_hinge,
    fit_sphere,
    hinge_correctives,
    hinge_weights,
    regressor_row,
    smoothstep,
)

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(60, 3))


@settings(max_examples=50, deadline=None)
@given(st.floats(0.01, 2.5), st.sampled_from([-1, 1]), st.floats(-3, 3), st.floats(-3, 3))
def test_hinge_is_recovered(angle, sign, y, z):
    center = np.array([0, y, z])
    moved = Rotation.from_rotvec([sign * angle, 0, 0]).apply(POINTS - center) + center
    hinge = fit_hinge(POINTS, moved)
    assert hinge.angle == pytest.approx(sign * angle, abs=1e-12)
    np.testing.assert_allclose(hinge.center, center, atol=1e-9)
    np.testing.assert_allclose(hinge.displacement(POINTS), moved - POINTS, atol=1e-12)


def test_hinge_is_the_least_squares_one():
    noisy = Rotation.from_rotvec([0.4, 0, 0]).apply(POINTS) + 0.05 * RNG.normal(size=POINTS.shape)
    hinge = fit_hinge(POINTS, noisy)

    def error(angle, center):
        return np.sum((Hinge(angle, center).displacement(POINTS) - (noisy - POINTS))[:, 1:] ** 2)

    best = error(*hinge)
    for change in ([1e-3, 0, 0], [-1e-3, 0, 0], [0, 1e-3, 0], [0, -1e-3, 0], [0, 0, 1e-3], [0, 0, -1e-3]):
        assert error(hinge.angle + change[0], hinge.center + [0, *change[1:]]) > best


def test_a_pure_shift_is_no_hinge():
    with pytest.raises(ValueError, match="no centre"):
        fit_hinge(POINTS, POINTS + [0, 1, 0])


def test_weights_and_correctives_reproduce_any_displacement():
    hinge = Hinge(0.4, np.array([0.0, 0.2, -0.1]))
    share = RNG.uniform(0, 1, len(POINTS))
    np.testing.assert_allclose(
        hinge_weights(hinge, POINTS, share[:, None] * hinge.displacement(POINTS), 0.0), share
    )
    displacement = RNG.normal(size=POINTS.shape)
    weights = hinge_weights(hinge, POINTS, displacement, 0.1)
    assert weights.min() >= 0
    assert weights.max() <= 1
    basis = hinge_correctives(hinge, POINTS, displacement, weights)
    posed = POINTS + basis @ (hinge.matrix - np.eye(3)).ravel()
    skinned = posed + weights[:, None] * hinge.displacement(posed)
    np.testing.assert_allclose(skinned, POINTS + displacement, atol=1e-12)
    assert not basis[:, :, [0, 1, 2, 3, 4, 6, 8]].any()


def test_sphere():
    directions = RNG.normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    center, radius = fit_sphere([0.3, -0.2, 0.9] + 0.012 * directions[directions[:, 2] < 0.3])
    np.testing.assert_allclose(center, [0.3, -0.2, 0.9], atol=1e-10)
    assert radius == pytest.approx(0.012, abs=1e-10)


def test_regressor_row_moves_with_the_mesh():
    support, target = np.arange(10, 40), np.array([0.2, -0.1, 0.3])
    row = regressor_row(POINTS, support, target)
    assert not row[:10].any()
    assert not row[40:].any()
    np.testing.assert_allclose(row.sum(), 1)
    np.testing.assert_allclose(row @ POINTS, target, atol=1e-14)
    turn = Rotation.random(random_state=0)
    np.testing.assert_allclose(row @ (3 * turn.apply(POINTS) + 1), 3 * turn.apply(target) + 1, atol=1e-13)
    flat = POINTS * [1, 1, 0]
    with pytest.raises(ValueError, match="span"):
        regressor_row(flat, support, target)


def test_smoothstep():
    np.testing.assert_allclose(smoothstep(np.array([-1.0, 0, 0.5, 1, 2]), 0, 1), [0, 0, 0.5, 1, 1])
