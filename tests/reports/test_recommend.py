"""``headbench recommend``: which method fits a budget, how sure that is, and what it is worth on subjects left out."""

import re

import numpy as np
import pytest

from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.rows import Row, Rows
from headbench.bench.specs import MetricSpec
from headbench.reports.recommend import (
    Choice,
    RecommendSettings,
    against_always,
    best_of,
    held_out,
    recommend,
)

METRICS = [
    MetricSpec("psnr", "PSNR", "dB", True, 2, "m:psnr"),
    MetricSpec("lpips", "LPIPS", "", False, 3, "m:lpips"),
    MetricSpec("storage", "Storage", "MB", False, 2, "m:storage", kind="avatar"),
    MetricSpec("training_time", "Training", "min", False, 1, "m:time", kind="avatar"),
]
SUBJECTS = [f"s{number}" for number in range(6)]


def choice(qualities, **costs):
    quality = dict(zip(SUBJECTS, qualities))
    return Choice(quality, {name: dict.fromkeys(quality, cost) for name, cost in costs.items()})


@pytest.fixture
def run(tmp_path, write_manifest):
    """A run of six subjects: ``large`` is better than ``small`` by 1 dB, ``floor`` is a trivial baseline."""
    folder, rows = RunFolder(tmp_path / "run"), []
    values = {
        "large": (30.0, 0.05, 8.0, 2.0),
        "small": (29.0, 0.08, 1.0, 4.0),
        "floor": (50.0, 0.0, 0.1, 0.0),
    }
    for method, (psnr, lpips, size, minutes) in values.items():
        for index, subject in enumerate(SUBJECTS):
            for t in range(2):
                frame = (method, "1", 0, "novel_view", subject, "EMO", t, "a", "full")
                rows += [Row(*frame, "psnr", psnr + index + t, "p"), Row(*frame, "lpips", lpips, "p")]
            avatar = (method, "1", 0, "", subject, "", -1, "", "full")
            rows += [Row(*avatar, "storage", size, ""), Row(*avatar, "training_time", minutes, "")]
    Rows.of(rows).write(folder.rows)
    write_manifest(folder, METRICS, dict.fromkeys(values), {"novel_view": "p"}, trivial=("floor",))
    return str(folder.root)


def asked(run, **settings):
    return recommend(RecommendSettings((run,), **{"task": "novel_view", **settings}))


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ({}, "large"),
        ({"megabytes": 8.0}, "large"),
        ({"megabytes": 7.9}, "small"),
        ({"seconds": 120.0}, "large"),
        ({"seconds": 240.0, "megabytes": 5.0}, "small"),
    ],
)
def test_the_best_method_within_all_limits_is_recommended(run, limits, expected):
    result = asked(run, **limits)
    assert result.data["recommended"] == expected
    assert result.text.startswith("Recommended for ")
    assert result.data["costs"]["seconds"] == {"large": 120.0, "small": 240.0}[expected]
    # 30 or 29, plus 0 to 5 for the subject, plus 0.5 for the frame.
    assert result.data["quality"] == pytest.approx({"large": 33.0, "small": 32.0}[expected])
    assert "floor" not in result.data["fitting"]


def test_lower_is_better_where_the_metric_says_so(run):
    assert asked(run, metric="lpips").data["recommended"] == "large"


def test_what_no_method_reaches_is_refused_with_the_least(run):
    with pytest.raises(InputError, match=re.escape("at least 120 s of training (large)")):
        asked(run, seconds=60.0)
    with pytest.raises(InputError, match="no measured milliseconds"):
        asked(run, milliseconds=5.0)


@pytest.mark.parametrize(
    ("settings", "says"), [({"task": "self_reenactment"}, "task"), ({"metric": "jod"}, "metric")]
)
def test_unknown_tasks_and_metrics_are_refused(run, settings, says):
    with pytest.raises(InputError, match=says):
        asked(run, **settings)


def test_a_limit_holds_for_every_subject():
    costly = Choice(dict.fromkeys(SUBJECTS, 30.0), {"megabytes": dict(zip(SUBJECTS, [1, 1, 1, 1, 1, 3]))})
    assert costly.fits({"megabytes": 3}, SUBJECTS)
    assert not costly.fits({"megabytes": 2}, SUBJECTS)
    assert costly.fits({"megabytes": 2}, SUBJECTS[:5])
    assert not costly.fits({"seconds": 1e9}, SUBJECTS)
    assert costly.fits({}, SUBJECTS)


def test_held_out_subjects_are_judged_by_the_others_alone():
    """One outlier carries the mean of ``a``: without that subject ``b`` is recommended, and loses 9 dB on it."""
    choices = {"a": choice([30, 30, 30, 30, 30, 40.0]), "b": choice([31, 31, 31, 31, 31, 31.0])}
    assert best_of(choices, SUBJECTS, 1.0) == "a"
    trials = held_out(choices, {}, SUBJECTS, 1.0)
    assert [trial.choice for trial in trials] == ["a"] * 5 + ["b"]
    assert [trial.loss for trial in trials] == [1.0] * 5 + [9.0]
    assert held_out(choices, {}, SUBJECTS[:1], 1.0) == []


def test_a_limit_that_a_subject_left_out_exceeds_is_counted():
    sizes = dict(zip(SUBJECTS, [1, 1, 1, 1, 1, 3]))
    choices = {
        "a": Choice(dict.fromkeys(SUBJECTS, 31.0), {"megabytes": sizes}),
        "b": choice([30.0] * 6, megabytes=1),
    }
    trials = held_out(choices, {"megabytes": 2}, SUBJECTS, 1.0)
    assert [trial.exceeds for trial in trials] == [False] * 5 + [True]


def test_recommendations_gain_what_larger_budgets_allow():
    """Budgets of 1 and 8 MB, of which only ``small`` fits both: the gain is half of the difference."""
    small, large = choice([29.0] * 6, megabytes=1), choice([31.0] * 6, megabytes=8)
    found = against_always({"small": small, "large": large}, ["megabytes"], SUBJECTS, 1.0)
    assert found["always"] == "small"
    assert found["budgets"] == 2
    assert found["gain"] == pytest.approx(1.0)
    assert found["p"] == pytest.approx(2 / 2**6)


def test_recommendations_gain_nothing_where_order_is_chance():
    rng = np.random.default_rng(0)
    choices = {str(n): choice(30 + rng.normal(size=6), megabytes=1) for n in range(5)}
    gain = against_always(choices, ["megabytes"], SUBJECTS, 1.0)["gain"]
    assert gain == pytest.approx(0.0)
