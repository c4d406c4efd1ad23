import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from headbench.reports.statistics import comparisons as sign_flip
from headbench.reports.statistics.comparisons import least_p, sign_flip_p, subjects_needed

differences = st.lists(st.integers(-50, 50), min_size=1, max_size=8)


@given(differences)
def test_equals_the_enumeration_of_all_assignments(values):
    # Whole numbers: sums are exact, so that ties are decided without a tolerance.
    observed = abs(sum(values))
    sums = [
        sum(s * v for s, v in zip(signs, values)) for signs in itertools.product((1, -1), repeat=len(values))
    ]
    assert sign_flip_p(values) == pytest.approx(np.mean([abs(total) >= observed for total in sums]))


def test_equals_scipys_permutation_test():
    values = np.random.default_rng(3).normal(0.3, 1, 11)
    expected = stats.permutation_test(
        (values,), np.mean, permutation_type="samples", n_resamples=np.inf, vectorized=True
    )
    assert sign_flip_p(values) == pytest.approx(expected.pvalue)


@given(differences, st.floats(1e-6, 1e6))
def test_neither_unit_nor_direction_matters(values, scale):
    assert sign_flip_p(np.array(values) * scale) == sign_flip_p(values) == sign_flip_p([-v for v in values])


@pytest.mark.parametrize(("subjects", "p"), [(5, 0.0625), (6, 0.03125), (9, 0.00390625), (10, 0.001953125)])
def test_the_least_p_is_that_of_differences_of_one_sign(subjects, p):
    assert least_p(subjects) == sign_flip_p(np.arange(1, subjects + 1)) == p


def test_more_subjects_are_drawn_and_agree_with_the_normal_distribution(monkeypatch):
    values = np.random.default_rng(0).normal(0.1, 1, 80)
    drawn = sign_flip_p(values)
    normal = 2 * stats.norm.sf(abs(values.sum()) / np.sqrt((values**2).sum()))
    assert drawn == pytest.approx(normal, abs=0.01)
    assert sign_flip_p(np.ones(80)) == least_p(80) > 0
    monkeypatch.setattr(sign_flip, "EXACT_UP_TO", 5)
    assert sign_flip_p(values[:12]) == pytest.approx(_exact(values[:12]), abs=0.005)


def _exact(values):
    signs = np.array(list(itertools.product((1, -1), repeat=len(values))))
    return np.mean(np.abs(signs @ values) >= abs(values.sum()) - 1e-9)


def test_nothing_and_no_difference_reject_nothing():
    assert sign_flip_p([]) == sign_flip_p([0.0] * 9) == least_p(0) == 1
    with pytest.raises(ValueError, match="finite"):
        sign_flip_p([1.0, np.nan])


@pytest.mark.parametrize(("comparisons", "subjects"), [(1, 6), (4, 8), (10, 9), (15, 10)])
def test_the_subjects_that_a_family_needs(comparisons, subjects):
    assert subjects_needed(0.05, comparisons) == subjects
    assert comparisons * least_p(subjects) <= 0.05 < comparisons * least_p(subjects - 1)
