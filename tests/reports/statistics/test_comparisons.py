import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench.rows import Row, Rows
from headbench.reports.statistics import comparisons
from headbench.reports.statistics.comparisons import best_set, holm

LEVELS = {"low": 20.0, "middle": 20.5, "high": 25.0}


def compare(rows, pairs, task, metric, *, higher_is_better):
    what = {"task": task, "metric": metric, "region": "full"}
    return comparisons.compare(Rows(rows), pairs, **what, higher_is_better=higher_is_better)


def rows_of(subjects, methods=LEVELS, metric="psnr", task="novel_view"):
    """Each method at its level, give or take a fixed pattern of 0.1 that no two subjects share."""
    generator = np.random.default_rng(0)
    return pd.DataFrame(
        Row(
            method,
            "1",
            0,
            task,
            f"s{s:02}",
            "EMO",
            t,
            "a",
            "full",
            metric,
            level + generator.normal(0, 0.1),
            "h",
        )
        for method, level in methods.items()
        for s in range(subjects)
        for t in range(4)
    )


def test_a_comparison_tells_size_certainty_and_verdict():
    rows = rows_of(9)
    one, two, three = compare(
        rows,
        [("high", "low"), ("high", "middle"), ("low", "middle")],
        "novel_view",
        "psnr",
        higher_is_better=True,
    )
    means = rows.groupby(["method", "subject"])["value"].mean()
    expected = means["high"] - means["low"]
    assert dict(one.differences) == pytest.approx(expected.to_dict())
    assert one.difference == pytest.approx(expected.mean())
    assert one.effect == pytest.approx(expected.mean() / expected.std())
    assert one.low < one.difference < one.high
    assert (one.wins, one.subjects, one.family, one.seeds) == (9, 9, 3, (1, 1))
    assert (one.p, one.p_holm) == (2**-8, 3 * 2**-8)
    assert [c.verdict for c in (one, two, three)] == ["high is better", "high is better", "middle is better"]
    assert three.wins == 0


def test_direction_decides_who_is_better():
    rows = rows_of(9, metric="lpips")
    (found,) = compare(rows, [("high", "low")], "novel_view", "lpips", higher_is_better=False)
    assert found.verdict == "low is better"
    assert found.wins == 0


@pytest.mark.parametrize(
    ("subjects", "verdict"),
    [(1, "not testable with 1 subject (it takes 6)"), (5, "not testable with 5 subjects (it takes 6)")],
)
def test_too_few_subjects_cannot_be_tested(subjects, verdict):
    (found,) = compare(rows_of(subjects), [("high", "low")], "novel_view", "psnr", higher_is_better=True)
    assert found.verdict == verdict
    assert found.difference == pytest.approx(5, abs=0.3)


def test_more_comparisons_need_more_subjects():
    pairs = [("high", "low"), ("high", "middle"), ("low", "middle")]
    found = compare(rows_of(6), pairs, "novel_view", "psnr", higher_is_better=True)
    assert {c.verdict for c in found} == {"not testable with 6 subjects (it takes 7)"}


def test_no_difference_cannot_be_told():
    rows = rows_of(8, {"a": 20.0, "b": 20.0})
    (found,) = compare(rows, [("a", "b")], "novel_view", "psnr", higher_is_better=True)
    assert found.verdict == "cannot be told apart"
    assert found.low < 0 < found.high


def test_an_incomplete_method_is_not_compared_and_does_not_count_in_the_family():
    rows = rows_of(9)
    rows = rows.drop(rows[(rows["method"] == "low")].index[0])
    found = compare(rows, [("high", "low"), ("high", "middle")], "novel_view", "psnr", higher_is_better=True)
    assert found[0].verdict == "no comparison"
    assert "low: 1 of 36 frames" in found[0].reason
    assert found[1].family == 1


def test_values_of_the_avatar_are_compared_too():
    rows = pd.DataFrame(
        Row(method, "1", seed, "", f"s{s}", "", -1, "", "full", "size", level + s, "")
        for method, level in (("a", 1.0), ("b", 3.0))
        for s in range(7)
        for seed in (0, 1)
    )
    (found,) = compare(rows, [("a", "b")], "", "size", higher_is_better=False)
    assert (found.difference, found.low, found.high) == pytest.approx((-2, -2, -2))
    assert found.verdict == "a is better"
    assert found.effect is None
    assert found.seeds == (2, 2)


def means_of(rows):
    means = rows.groupby(["method", "subject"])["value"].mean()
    return {method: means[method].to_dict() for method in LEVELS}


def test_the_best_are_those_that_nothing_is_told_to_be_better_than():
    means = means_of(rows_of(9, {"low": 20.0, "middle": 25.0, "high": 25.0}))
    assert best_set(means, higher_is_better=True).methods == {"middle", "high"}
    assert best_set(means, higher_is_better=False).methods == {"low"}


def test_too_few_subjects_leave_the_best_open():
    found = best_set(means_of(rows_of(6)), higher_is_better=True)
    assert (found.methods, found.subjects, found.needed) == (None, 6, 7)
    assert best_set(means_of(rows_of(7)), higher_is_better=True).methods == {"high"}


@settings(deadline=None, max_examples=15)
@given(st.integers(2, 4), st.integers(7, 8), st.integers(0, 10_000), st.booleans())
def test_the_set_holds_the_highest_mean_and_leaves_out_by_holm(methods, subjects, seed, higher):
    from scipy import stats

    values = np.random.default_rng(seed).normal(0, 1, (methods, subjects)) + np.arange(methods)[:, None]
    means = {str(i): {str(j): v for j, v in enumerate(row)} for i, row in enumerate(values)}
    found = best_set(means, higher_is_better=higher).methods
    top = values.mean(axis=1).argmax() if higher else values.mean(axis=1).argmin()
    assert str(top) in found
    for i in range(methods):
        others = [j for j in range(methods) if j != i]
        p_values = [
            stats.permutation_test(
                (values[j] - values[i],),
                np.mean,
                permutation_type="samples",
                n_resamples=np.inf,
                vectorized=True,
            ).pvalue
            for j in others
        ]
        better = [(values[j].mean() > values[i].mean()) == higher for j in others]
        assert (str(i) not in found) == any(p <= 0.05 and b for p, b in zip(holm(p_values), better))
