import numpy as np
import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.bench.rows import Rows
from headbench.reports.aggregate import summarise
from headbench.reports.runs import explained


def keys(subject, cameras):
    return [FrameKey(subject, "FREE", timestep, camera) for camera in cameras for timestep in (0, 1)]


def test_cameras_are_counted_by_subject_if_all_have_as_many():
    frames = [*keys("s1", "abc"), *keys("s2", "abd")]
    text = explained(frames, {("s1", "c"), ("s2", "d")})
    assert text.startswith("Seen cameras (2 scored) have training frames")
    assert text.endswith("unseen cameras (1 scored) have none.")
    assert "scored" not in explained([*frames, *keys("s2", "e")], {("s1", "c"), ("s2", "d")})


def summary(rows, task, metric, method="a"):
    return summarise(Rows(rows), method, metric, task)


def test_each_level_weighs_its_members_equally(make_rows):
    values = {"EMO": (1.0, 2.0, 6.0), "EXP": 11.0, "s2": 100.0}

    def value(metric, seed, subject, sequence, timestep, camera):
        one = values["s2"] if subject == "s2" else values[sequence]
        return (one[timestep] if isinstance(one, tuple) else one) + 10 * seed

    rows = make_rows({"a": value}, seeds=(0, 2))
    subject_1 = ((1 + 2 + 6) / 3 + 11) / 2
    for table in (rows, rows.sample(frac=1, random_state=1)):
        found = summary(table, "novel_view", "psnr")
        assert found.value == pytest.approx((subject_1 + 100) / 2 + (0 + 20) / 2)
        assert found.spread == pytest.approx(20 / 2**0.5)


@pytest.mark.parametrize(
    ("seeds", "gone", "reason"),
    [
        ((0,), ("novel_view", "EXP", 0), "1 of 5 frames"),
        ((0, 1), ("novel_view", "EXP", 1), "1 of 10 frames"),
        ((0,), ("", "", 0), "1 of 2 avatars"),
    ],
)
def test_a_method_that_lacks_a_value_has_no_mean(make_rows, seeds, gone, reason):
    rows = make_rows({"a": 1.0, "b": 1.0}, seeds=seeds)
    place = rows[["task", "sequence", "seed"]].apply(tuple, axis=1) == gone
    rows = rows[~(place & (rows["method"] == "a") & ((rows["task"] != "") | (rows["subject"] == "s2")))]
    metric = "psnr" if gone[0] else "size"
    aggregate = summary(rows, gone[0], metric)
    assert (aggregate.value, aggregate.status) == (None, "missing")
    assert reason in aggregate.reason
    assert summary(rows, gone[0], metric, method="b").value == 1.0
    assert summary(rows, "self_reenactment", "psnr").value == 1.0


@pytest.mark.parametrize("status", ["missing", "failed"])
def test_one_value_without_a_number_names_the_reason(make_rows, status):
    rows = make_rows({"a": 1.0})
    where = (rows["task"] == "novel_view") & (rows["metric"] == "lpips") & (rows["timestep"] == 1)
    rows.loc[where, ["status", "value", "reason"]] = [status, np.nan, "no weights\n here"]
    aggregate = summary(rows, "novel_view", "lpips")
    assert (aggregate.status, aggregate.value) == (status, None)
    assert aggregate.reason == f"1 of 5 values {status}: no weights here"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.iloc[[0, 0]], "repeats"),
        (lambda r: r.assign(version=[str(i) for i in range(len(r))]), "one version"),
    ],
)
def test_faulty_rows_are_refused(make_rows, change, message):
    rows = make_rows({"a": 1.0})
    Rows(rows).check()
    with pytest.raises(InputError, match=message):
        Rows(change(rows)).check()
