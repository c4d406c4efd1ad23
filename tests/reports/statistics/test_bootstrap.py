import dataclasses

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from headbench.bench.errors import InputError
from headbench.reports.aggregate import subject_means
from headbench.reports.statistics.bootstrap import SequencePairs, SubjectPairs, block_length, interval, pair
from headbench.reports.statistics.calibration import Population


@pytest.fixture
def rows(make_rows):
    """Two methods, the first with three seeds; every value another."""
    generator = np.random.default_rng(0)

    def of(method, seeds):
        rows = make_rows({method: lambda *place: generator.normal()}, tasks=("novel_view",), seeds=seeds)
        return rows[rows["metric"] == "psnr"]

    return of("a", (0, 1, 2)), of("b", (7,))


def test_the_difference_is_that_of_the_tables_means(rows):
    first, second = (subject_means(table) for table in rows)
    subjects = pair(*(table.sample(frac=1, random_state=1) for table in rows))
    differences = {s.subject: s.difference for s in subjects}
    assert differences == pytest.approx({name: first[name] - second[name] for name in ("s1", "s2")})
    by_seed = [subject_means(rows[0][rows[0]["seed"] == seed])["s1"] for seed in (0, 1, 2)]
    assert subjects[0].means()[0] == pytest.approx(by_seed)


def test_cameras_of_a_timestep_stay_together(rows):
    first, second = (r.assign(camera="b", value=r["value"] + 10) for r in rows)
    many = [pd.concat([r, other], ignore_index=True) for r, other in zip(rows, (first, second))]
    sequence = pair(*many)[0].sequences[0]
    assert list(sequence.cameras) == [2, 2, 2]
    assert sequence.first.shape == (3, 3)
    assert sequence.second.shape == (1, 3)
    alone = pair(*rows)[0].sequences[0]
    assert sequence.first == pytest.approx(2 * alone.first + 10)
    assert sequence.centred == pytest.approx(alone.centred)
    assert sequence.centred.sum() == pytest.approx(0)


def test_frames_of_one_method_alone_are_refused(rows):
    first, second = rows
    with pytest.raises(InputError, match="a value of both methods"):
        pair(first, second.iloc[:-1])
    with pytest.raises(InputError, match="in every seed"):
        pair(first.iloc[:-1], second)
    with pytest.raises(InputError, match="one value of each frame"):
        pair(first, second.iloc[[0, *range(len(second))]])


def subjects_of(values):
    """Subjects of one value each: nothing varies within them."""
    one = np.ones(1)
    return [
        SubjectPairs(str(i), (SequencePairs(v * one[None], 0 * one[None], one),))
        for i, v in enumerate(values)
    ]


def test_many_normal_subjects_have_students_interval():
    values = np.random.default_rng(1).normal(3, 2, 60)
    expected = stats.t.interval(0.95, 59, values.mean(), stats.sem(values))
    assert interval(subjects_of(values), replicates=20_000) == pytest.approx(expected, abs=0.06)


def test_skew_moves_the_interval():
    # For a long tail to the right the mean is underestimated more often, so the interval reaches further up.
    values = np.random.default_rng(0).exponential(1, 40)
    low, high = interval(subjects_of(values))
    assert high - values.mean() > 1.1 * (values.mean() - low)


@settings(deadline=None, max_examples=20)
@given(st.floats(-100, 100), st.floats(0.01, 100))
def test_follows_shift_and_unit(shift, scale):
    population = Population(5, sequences=2, timesteps=20)
    subjects = population.draw(np.random.default_rng(4))
    low, high = interval(subjects, replicates=300)

    def changed(sequence):
        return dataclasses.replace(
            sequence,
            first=scale * (sequence.first + shift * sequence.cameras),
            second=scale * sequence.second,
        )

    moved = [SubjectPairs(s.subject, tuple(map(changed, s.sequences))) for s in subjects]
    assert interval(moved, replicates=300) == pytest.approx(
        (scale * (low + shift), scale * (high + shift)), abs=1e-6 * scale
    )


def test_exchanging_the_methods_mirrors_it():
    subjects = Population(40, sequences=2, timesteps=10, mean=1.0).draw(np.random.default_rng(2))
    swapped = [
        SubjectPairs(s.subject, tuple(SequencePairs(q.second, q.first, q.cameras) for q in s.sequences))
        for s in subjects
    ]
    low, high = interval(subjects)
    assert interval(swapped) == pytest.approx((-high, -low), abs=0.02)


def test_the_same_input_gives_the_same_interval():
    subjects = Population(9, seeds=3, seed_sd=0.2).draw(np.random.default_rng(0))
    assert interval(subjects) == interval(subjects) != interval(subjects, seed=1)
    wide, narrow = interval(subjects), interval(subjects, level=0.5)
    assert wide[0] < narrow[0] < narrow[1] < wide[1]


def test_too_few_subjects_have_none():
    subjects = Population(3).draw(np.random.default_rng(0))
    assert interval(subjects) is not None
    assert interval(subjects[:2]) is None
    assert interval(subjects_of([1.0, 2.0, 4.0])) is None  # a ninth of the replicates has one subject alone
    assert interval(subjects_of([2.0] * 3)) == (2.0, 2.0)


@pytest.mark.parametrize(("correlation", "length"), [(0.0, 1), (0.5, 10), (0.95, 44)])
def test_blocks_are_as_long_as_the_correlation_asks(correlation, length):
    # (sqrt(6) r / (1 - r^2))^(2/3) T^(1/3) at T = 150: 0, 7.3, 44.1; estimates of r scatter.
    subjects = Population(30, sequences=4, subject_sd=0, sequence_sd=0, correlation=correlation).draw(
        np.random.default_rng(0)
    )
    found = np.mean([block_length(s.sequences) for s in subjects])
    assert length / 2 <= found <= length * 1.3 + 1


def test_blocks_are_at_most_a_third_and_at_least_one_timestep():
    (subject,) = Population(1, timesteps=30, correlation=0.99).draw(np.random.default_rng(0))
    assert block_length(subject.sequences) == 10
    assert block_length(subjects_of([1.0])[0].sequences) == 1


def test_the_difference_of_two_tasks_has_students_interval():
    first, second = np.random.default_rng(1).normal(3, 2, (2, 60))
    found = interval(subjects_of(first), replicates=20_000, less=subjects_of(second))
    expected = stats.t.interval(0.95, 59, (first - second).mean(), stats.sem(first - second))
    assert found == pytest.approx(expected, abs=0.08)


def test_seeds_that_move_both_tasks_alike_widen_nothing():
    generator = np.random.default_rng(0)
    one = np.ones(1)
    tasks = ([], [])
    for subject in range(12):
        seeds = generator.normal(0, 10, 3)
        for index, task in enumerate(tasks):
            own = generator.normal(index, 0.1)
            pairs = SequencePairs((seeds + own)[:, None], 0 * one[None], one)
            task.append(SubjectPairs(str(subject), (pairs,)))
    low, high = interval(tasks[0], less=tasks[1])
    assert low < -1 < high
    assert high - low < 0.5
    alone = interval(tasks[0])
    assert alone[1] - alone[0] > 5


def test_tasks_of_other_subjects_are_refused():
    subjects = subjects_of([1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="the same in both tasks: 0, 1, 2"):
        interval(subjects, less=subjects[:2])
