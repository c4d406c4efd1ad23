import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from headbench.bench.errors import InputError
from headbench.reports.statistics.comparisons import half_width, interval, paired_differences


@pytest.fixture
def rows(make_rows):
    """Two methods, the first with three seeds; every value another."""
    generator = np.random.default_rng(0)

    def of(method, seeds):
        rows = make_rows({method: lambda *place: generator.normal()}, tasks=("novel_view",), seeds=seeds)
        return rows[rows["metric"] == "psnr"]

    return of("a", (0, 1, 2)), of("b", (7,))


def test_differences_are_of_the_means_of_subjects(rows):
    shuffled = [table.sample(frac=1, random_state=1) for table in rows]
    # Independent of the table's code: nested means by pandas.
    means = [
        table.groupby(["subject", "seed", "sequence"])["value"].mean().groupby("subject").mean()
        for table in rows
    ]
    assert paired_differences(*shuffled) == pytest.approx((means[0] - means[1]).to_dict())


def test_frames_of_one_method_alone_are_refused(rows):
    first, second = rows
    with pytest.raises(InputError, match="a value of both methods"):
        paired_differences(first, second.iloc[:-1])
    with pytest.raises(InputError, match="in every seed"):
        paired_differences(first.iloc[:-1], second)
    with pytest.raises(InputError, match="one value of each frame"):
        paired_differences(first, pd.concat([second.iloc[:1], second]))


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=12))
def test_the_interval_is_that_of_a_paired_t_test(values):
    if np.ptp(values) > 1e-6:
        expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
        assert interval(values) == pytest.approx((expected.low, expected.high), rel=1e-9, abs=1e-9)
    assert interval(values[:2]) is None


def test_equal_values_have_an_interval_of_no_width():
    assert interval([2.0] * 4) == (2.0, 2.0)


def test_half_width_by_the_printed_table_of_student():
    # t(0.975, 3) = 3.182, t(0.95, 3) = 2.353; the standard deviation of 0, 0, 0, 2 is 1.
    assert half_width([0.0, 0.0, 0.0, 2.0]) == pytest.approx(3.182 / 2, abs=5e-4)
    assert half_width([0.0, 0.0, 0.0, 2.0], 0.1) == pytest.approx(2.353 / 2, abs=5e-4)
