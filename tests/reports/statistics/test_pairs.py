import numpy as np
import pandas as pd
import pytest

from headbench.bench.errors import InputError
from headbench.reports.aggregate import macro_mean
from headbench.reports.statistics.bootstrap import pair


@pytest.fixture
def rows(make_rows):
    """Two methods, the first with three seeds; every value another."""
    generator = np.random.default_rng(0)

    def of(method, seeds):
        rows = make_rows({method: lambda *place: generator.normal()}, tasks=("novel_view",), seeds=seeds)
        return rows[rows["metric"] == "psnr"]

    return of("a", (0, 1, 2)), of("b", (7,))


def test_the_difference_is_that_of_the_tables_means(rows):
    first, second = rows
    subjects = pair(first, second)
    assert [subject.subject for subject in subjects] == ["s1", "s2"]
    assert np.mean([subject.difference for subject in subjects]) == pytest.approx(
        macro_mean(first) - macro_mean(second)
    )
    own = first[first["subject"] == "s1"], second[second["subject"] == "s1"]
    assert subjects[0].difference == pytest.approx(macro_mean(own[0]) - macro_mean(own[1]))


def test_each_seed_has_its_mean(rows):
    first, second = rows
    means, _ = pair(first, second)[0].means()
    expected = [macro_mean(first[(first["seed"] == s) & (first["subject"] == "s1")]) for s in (0, 1, 2)]
    assert means == pytest.approx(expected)


def test_the_order_of_rows_means_nothing(rows):
    first, second = rows
    shuffled = pair(first.sample(frac=1, random_state=1), second.sample(frac=1, random_state=2))
    assert [s.difference for s in shuffled] == [s.difference for s in pair(first, second)]


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
