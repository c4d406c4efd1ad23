"""Elements that plots share."""

import pytest
from matplotlib.figure import Figure

from headbench.reports.drawing import cost_axis


@pytest.mark.parametrize(
    ("costs", "whole", "logarithmic", "expected"),
    [
        ([1, 4, 16], True, True, [1, 2, 5, 10]),
        ([4.9, 30.0, 117.0], False, True, [5, 10, 20, 50, 100]),
        ([100.0, 600.0], False, True, [100, 200, 500]),
        ([3, 6], True, True, [3, 4, 5, 6]),
        ([0.0, 1.0, 2.0], False, False, [0, 0.5, 1, 1.5, 2]),
    ],
)
def test_numbers_of_an_axis_are_few_and_in_view(costs, whole, logarithmic, expected):
    axes = Figure().subplots()
    axes.plot(costs, costs)
    cost_axis(axes, logarithmic=logarithmic, whole=whole)
    low, high = axes.get_xlim()
    assert [tick for tick in axes.get_xticks() if low <= tick <= high] == pytest.approx(expected)
