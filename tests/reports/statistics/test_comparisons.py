import itertools

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from headbench.bench.errors import InputError
from headbench.bench.rows import Rows
from headbench.reports.statistics import comparisons
from headbench.reports.statistics.comparisons import (
    best_set,
    detectable,
    equivalence_p,
    half_width,
    holm,
    interval,
    least_p,
    paired_differences,
    paired_power,
    sign_flip_p,
    subjects_needed,
)

from ..made_rows import avatar_row, row

LEVELS = {"low": 20.0, "middle": 20.5, "high": 25.0}
PAIRS = [("high", "low"), ("high", "middle"), ("low", "middle")]


def compare(rows, pairs, task="novel_view", metric="psnr", *, higher_is_better=True, **options):
    what = {"task": task, "metric": metric, "higher_is_better": higher_is_better, **options}
    return comparisons.compare(Rows(rows), pairs, **what)


def rows_of(subjects, methods=LEVELS, metric="psnr"):
    """Each method at its level, give or take a fixed pattern of 0.1 that no two subjects share."""
    generator = np.random.default_rng(0)
    return pd.DataFrame(
        row(method, metric, level + generator.normal(0, 0.1), f"s{s:02}", timestep=t)
        for method, level in methods.items()
        for s in range(subjects)
        for t in range(4)
    )


def test_a_comparison_tells_size_certainty_and_verdict():
    rows = rows_of(9)
    one, two, three = compare(rows, PAIRS)
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


@pytest.mark.parametrize(
    ("subjects", "pairs", "verdict"),
    [
        (1, PAIRS[:1], "not testable with 1 subject (it takes 6)"),
        (5, PAIRS[:1], "not testable with 5 subjects (it takes 6)"),
        (6, PAIRS, "not testable with 6 subjects (it takes 7)"),
    ],
)
def test_too_few_subjects_cannot_be_tested(subjects, pairs, verdict):
    found = compare(rows_of(subjects), pairs)
    assert {c.verdict for c in found} == {verdict}
    assert found[0].difference == pytest.approx(5, abs=0.3)


def test_no_difference_cannot_be_told():
    (found,) = compare(rows_of(8, {"a": 20.0, "b": 20.0}), [("a", "b")])
    assert found.verdict == "no significant difference"
    assert found.low < 0 < found.high


def test_an_incomplete_method_does_not_count_in_the_family():
    rows = rows_of(9)
    rows = rows.drop(rows[(rows["method"] == "low")].index[0])
    found = compare(rows, PAIRS[:2])
    assert found[0].verdict == "no comparison"
    assert "low: 1 of 36 frames" in found[0].reason
    assert found[1].family == 1


def test_values_of_the_avatar_are_compared_too():
    rows = pd.DataFrame(
        avatar_row(method, "size", level + s, f"s{s}", seed=seed)
        for method, level in (("a", 1.0), ("b", 3.0))
        for s in range(7)
        for seed in (0, 1)
    )
    (found,) = compare(rows, [("a", "b")], "", "size", higher_is_better=False)
    assert (found.difference, found.low, found.high) == pytest.approx((-2, -2, -2))
    assert found.verdict == "a is better"
    assert found.effect is None
    assert found.seeds == (2, 2)


def permutation_p(values, **options):
    options |= {"permutation_type": "samples", "n_resamples": np.inf, "vectorized": True}
    return stats.permutation_test((values,), np.mean, **options).pvalue


def means_of(rows):
    means = rows.groupby(["method", "subject"])["value"].mean()
    return {method: means[method].to_dict() for method in LEVELS}


def test_the_best_are_those_that_nothing_is_better_than():
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
    values = np.random.default_rng(seed).normal(0, 1, (methods, subjects)) + np.arange(methods)[:, None]
    means = {str(i): {str(j): v for j, v in enumerate(row)} for i, row in enumerate(values)}
    found = best_set(means, higher_is_better=higher).methods
    top = values.mean(axis=1).argmax() if higher else values.mean(axis=1).argmin()
    assert str(top) in found
    for i in range(methods):
        others = [j for j in range(methods) if j != i]
        p_values = [permutation_p(values[j] - values[i]) for j in others]
        better = [(values[j].mean() > values[i].mean()) == higher for j in others]
        assert (str(i) not in found) == any(p <= 0.05 and b for p, b in zip(holm(p_values), better))


differences = st.lists(st.integers(-50, 50), min_size=1, max_size=8)


@given(differences)
def test_equals_the_enumeration_of_all_assignments(values):
    # Whole numbers: sums are exact, so that ties are decided without a tolerance.
    observed = abs(sum(values))
    sums = [
        sum(s * v for s, v in zip(signs, values)) for signs in itertools.product((1, -1), repeat=len(values))
    ]
    assert sign_flip_p(values) == pytest.approx(np.mean([abs(total) >= observed for total in sums]))


@given(differences, st.floats(1e-6, 1e6))
def test_neither_unit_nor_direction_matters(values, scale):
    assert sign_flip_p(np.array(values) * scale) == sign_flip_p(values) == sign_flip_p([-v for v in values])


@pytest.mark.parametrize(("subjects", "p"), [(5, 0.0625), (6, 0.03125), (9, 0.00390625), (10, 0.001953125)])
def test_the_least_p_is_that_of_differences_of_one_sign(subjects, p):
    assert least_p(subjects) == sign_flip_p(np.arange(1, subjects + 1)) == p


def test_assignments_of_many_subjects_are_drawn(monkeypatch):
    values = np.random.default_rng(0).normal(0.1, 1, 80)
    drawn = sign_flip_p(values)
    normal = 2 * stats.norm.sf(abs(values.sum()) / np.sqrt((values**2).sum()))
    assert drawn == pytest.approx(normal, abs=0.01)
    assert sign_flip_p(np.ones(80)) == least_p(80) > 0
    monkeypatch.setattr(comparisons, "EXACT_UP_TO", 5)
    assert sign_flip_p(values[:12]) == pytest.approx(permutation_p(values[:12]), abs=0.005)


def test_nothing_and_no_difference_reject_nothing():
    assert sign_flip_p([]) == sign_flip_p([0.0] * 9) == least_p(0) == 1


@pytest.mark.parametrize(("comparisons", "subjects"), [(1, 6), (4, 8), (10, 9), (15, 10)])
def test_the_subjects_that_a_family_needs(comparisons, subjects):
    assert subjects_needed(0.05, comparisons) == subjects
    assert comparisons * least_p(subjects) <= 0.05 < comparisons * least_p(subjects - 1)


p_values = st.lists(st.floats(0, 1), min_size=1, max_size=7)


def rejected_step_by_step(values, level):
    """Holm's own description: go on from the least p-value while it is at most the level over those left."""
    rejected = set()
    for done, index in enumerate(sorted(range(len(values)), key=values.__getitem__)):
        if values[index] * (len(values) - done) > level:
            break
        rejected.add(index)
    return rejected


@given(p_values, st.sampled_from([0.01, 0.05, 0.1]))
def test_rejects_what_the_sequential_procedure_rejects(values, level):
    adjusted = holm(values)
    assert {i for i, p in enumerate(adjusted) if p <= level} == rejected_step_by_step(values, level)


def test_an_example_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


@given(differences)
def test_one_sided_equals_the_enumeration_too(values):
    signs = itertools.product((1, -1), repeat=len(values))
    sums = [sum(s * v for s, v in zip(each, values)) for each in signs]
    expected = np.mean([total >= sum(values) for total in sums])
    assert sign_flip_p(values, greater=True) == pytest.approx(expected)


def test_one_sided_assignments_are_drawn_alike(monkeypatch):
    values = np.random.default_rng(0).normal(0.4, 1, 12)
    exact = permutation_p(values, alternative="greater")
    assert sign_flip_p(values, greater=True) == pytest.approx(exact)
    monkeypatch.setattr(comparisons, "EXACT_UP_TO", 5)
    assert sign_flip_p(values, greater=True) == pytest.approx(exact, abs=0.005)


@pytest.mark.parametrize("mean", [-0.5, 0.0, 0.25])
def test_equivalence_is_two_one_sided_tests(mean):
    values = np.random.default_rng(1).normal(mean, 0.2, 9)
    below = permutation_p(values + 0.3, alternative="greater")
    above = permutation_p(values - 0.3, alternative="less")
    assert equivalence_p(values, 0.3) == pytest.approx(max(below, above))
    assert equivalence_p(-values, 0.3) == pytest.approx(equivalence_p(values, 0.3))


def test_equivalence_of_ten_alike_has_the_least_p():
    assert equivalence_p(np.zeros(10), 0.3) == 2**-10
    assert equivalence_p([], 0.3) == 1


def test_equivalence_is_corrected_over_the_pairs():
    rows = rows_of(9, {"a": 20.0, "b": 20.02, "c": 25.0})
    pairs = [("a", "b"), ("a", "c"), ("b", "c")]
    found = compare(rows, pairs, margin=0.3)
    assert [c.p_equivalence for c in found] == [2**-9, 1, 1]
    assert [c.p_equivalence_holm for c in found] == [3 * 2**-9, 1, 1]
    assert [c.equivalent for c in found] == [True, False, False]
    assert [c.p_holm for c in found] == [c.p_holm for c in compare(rows, pairs)]
    assert {c.equivalent for c in compare(rows, pairs)} == {None}


def two_tasks():
    """Method a ahead of b by 1 in the first task and by 2 in the other, each give or take 0.1."""
    generator = np.random.default_rng(5)
    return pd.DataFrame(
        row(m, "psnr", level * (1 + i) + generator.normal(0, 0.1), f"s{s}", timestep=t, task=task)
        for m, level in (("a", 1.0), ("b", 0.0))
        for i, task in enumerate(("novel_view", "self_reenactment"))
        for s in range(8)
        for t in range(4)
    )


def test_an_interaction_is_a_difference_of_differences():
    rows = two_tasks()
    (found,) = compare(rows, [("a", "b")], minus="self_reenactment")
    means = rows.groupby(["method", "task", "subject"])["value"].mean().unstack("subject")
    by_task = means.loc["a"] - means.loc["b"]
    expected = by_task.loc["novel_view"] - by_task.loc["self_reenactment"]
    assert dict(found.differences) == pytest.approx(expected.to_dict())
    assert found.p == pytest.approx(permutation_p(expected.to_numpy()))
    assert found.low < expected.mean() < found.high
    assert found.high - found.low < 0.4
    assert found.verdict == "depends on the task"


def test_an_interaction_takes_both_tasks():
    rows = two_tasks()
    alone = rows[rows["task"] == "novel_view"]
    (found,) = compare(alone, [("a", "b")], minus="self_reenactment")
    assert found.verdict == "no comparison"
    assert "Not measured" in found.reason


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


@pytest.mark.parametrize(
    ("effect", "subjects", "level", "power"),
    [
        (0.5, 34, 0.05, 0.8078),  # G*Power 3.1, two-sided t test of matched pairs
        (0.0, 10, 0.01, 0.01),
        (50.0, 6, 0.01, 1.0),
    ],
)
def test_power_is_that_of_the_paired_t_test(effect, subjects, level, power):
    assert paired_power(effect, subjects, level) == pytest.approx(power, abs=1e-4)


def test_the_detectable_effect_is_found_as_often_as_asked():
    values = np.random.default_rng(0).normal(detectable(10, 0.01, 0.7), 1.0, (20_000, 10))
    assert (stats.ttest_1samp(values, 0.0, axis=1).pvalue < 0.01).mean() == pytest.approx(0.7, abs=0.01)
