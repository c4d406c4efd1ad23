"""Rounding to integers and the three components of a quaternion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from headbench.methods.compact.container import dequantise, from_smallest_three, quantise, smallest_three


@given(
    hnp.arrays(np.float32, st.integers(0, 30), elements=st.floats(-100, 100, width=32)),
    st.floats(1e-3, 0.9),
)
def test_rounding_errs_by_half_a_step_at_most(values, step):
    found = dequantise(quantise(values, step), step)
    assert np.all(np.abs(found.astype(float) - values) <= 0.5 * step + 1e-5)


@pytest.mark.parametrize(("largest", "dtype"), [(127, np.uint8), (128, np.uint16), (32768, np.uint32)])
def test_the_smallest_type_is_taken(largest, dtype):
    values = np.array([0.0, -largest, largest])
    folded = quantise(values, 1.0)
    assert folded.dtype == dtype
    np.testing.assert_array_equal(dequantise(folded, 1.0), values)


def test_what_no_integer_holds_is_clamped():
    found = dequantise(quantise(np.array([1e30, -1e30]), 0.5), 0.5)
    np.testing.assert_allclose(found, [2.0**29, -(2.0**29)], rtol=1e-6)


def covariance(quats, scales):
    """By another library."""
    turn = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    return turn @ (scales[:, :, None] ** 2 * turn.transpose(0, 2, 1))


@given(st.integers(0, 2**32 - 1))
def test_three_components_turn_a_gaussian_the_same(seed):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(40, 4)) * rng.uniform(0.1, 5, size=(40, 1))
    scales = rng.uniform(0.01, 1, size=(40, 3))
    imaginary = smallest_three(quats)
    assert np.abs(imaginary).max() <= 0.5**0.5 + 1e-12
    found = from_smallest_three(imaginary)
    assert np.all(found[:, 0] >= np.abs(found[:, 1:]).max(1) - 1e-6)
    np.testing.assert_allclose(covariance(found, scales), covariance(quats, scales), atol=1e-6)


def test_components_too_large_for_a_unit_still_give_one():
    found = from_smallest_three(np.array([[0.8, 0.8, 0.8], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-6)
