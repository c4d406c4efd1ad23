"""Bounded least squares against scipy's, which works on the matrix itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from headbench.datasets.head.refit.problem import solve_bounded


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


def test_only_the_lower_triangle_is_read():
    gram = np.array([[2.0, np.nan], [0.5, 1.0]])
    found = solve_bounded(gram, np.array([1.0, 5.0]), np.array([9.0, 2.0]))
    np.testing.assert_allclose(found, [0.0, 2.0], atol=1e-12)


def test_an_indefinite_matrix_is_refused():
    with pytest.raises(ValueError, match="positive definite"):
        solve_bounded(np.diag([1.0, -1.0]), np.ones(2), np.ones(2))
