import numpy as np
import pytest

from headbench.datasets.rounding import on_grid


@pytest.mark.parametrize(
    ("value", "rounded"), [(0.3, 0.25), (0.375, 0.5), (0.125, 0.0), (-0.6, -0.5), (-1e-18, 0.0), (7.0, 7.0)]
)
def test_values_go_to_the_nearest_multiple_ties_to_even(value, rounded):
    found = on_grid(np.array([value]), 2)
    np.testing.assert_array_equal(found, [rounded])
    assert not np.signbit(found[0]) or rounded < 0.0
