"""``headbench recommend``: choices within limits, and tests of the answer on subjects left out."""

import itertools
import re
from dataclasses import replace

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
    best_by_cost,
    best_of,
    held_out,
    recommend,
)

from .made_rows import avatar_row, row

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


def test_limits_that_nothing_fits_are_refused_with_the_nearest(run):
    with pytest.raises(InputError, match=re.escape("large nearest, with 120 s of training")):
        asked(run, seconds=60.0)
    with pytest.raises(InputError, match="small nearest, with 240 s of training and 1 MB"):
        asked(run, seconds=180.0, megabytes=1.0)  # ``large`` exceeds the second limit by a factor of 8
    with pytest.raises(InputError, match="none with measured milliseconds"):
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


def test_the_best_choice_up_to_each_cost():
    made = {
        "small": (29.0, 1),
        "worse": (28.0, 2),
        "middle": (30.0, 4),
        "equal": (30.0, 5),
        "large": (31.0, 8),
    }
    choices = {name: choice([quality] * 6, megabytes=size) for name, (quality, size) in made.items()}
    choices["unknown"] = choice([50.0] * 6)
    found = best_by_cost(choices, "megabytes", SUBJECTS, 1.0)
    assert found == [(1, "small"), (4, "middle"), (8, "large")]
    assert best_by_cost(choices, "megabytes", SUBJECTS, -1.0) == [(1, "small"), (2, "worse")]


def test_a_choice_that_exceeds_a_limit_has_no_loss():
    sizes = dict(zip(SUBJECTS, [1, 1, 1, 1, 1, 3]))
    choices = {
        "a": Choice(dict.fromkeys(SUBJECTS, 31.0), {"megabytes": sizes}),
        "b": choice([30.0] * 6, megabytes=1),
    }
    trials = held_out(choices, {"megabytes": 2}, SUBJECTS, 1.0)
    # Without the last subject ``a`` fits; with it, ``b`` is all that is left to recommend for the others.
    assert [(trial.choice, trial.loss) for trial in trials] == [("b", 1.0)] * 5 + [("a", None)]


def test_recommendations_gain_what_budgets_allow():
    """The best on average fits one of three budgets, the smallest all: in the second budget ``middle`` is 1 dB better."""
    sizes = {"small": (29.0, 1), "middle": (30.0, 4), "large": (31.0, 8)}
    choices = {name: choice([quality] * 6, megabytes=size) for name, (quality, size) in sizes.items()}
    found = against_always(choices, ["megabytes"], SUBJECTS, 1.0)
    assert found["always"] == "large"
    assert found["gains"] == dict.fromkeys(SUBJECTS, pytest.approx(1 / 3))
    assert found["exceeded"] == 0


def test_budgets_exceeded_on_the_subject_left_out_do_not_count():
    sizes = dict(zip(SUBJECTS, [2, 2, 2, 2, 2, 9]))
    choices = {
        "big": Choice(dict.fromkeys(SUBJECTS, 35.0), {"megabytes": sizes}),
        "small": choice([30.0] * 6, megabytes=3),
    }
    found = against_always(choices, ["megabytes"], SUBJECTS, 1.0)
    assert found["exceeded"] == 2
    assert "s5" not in found["gains"]


def test_recommendations_lose_where_the_order_is_chance():
    """Qualities that are noise: what was best for the others is no better than the best on average, on the mean over draws."""
    rng, gains = np.random.default_rng(0), []
    for _ in range(200):
        choices = {str(n): choice(30 + rng.normal(size=6), megabytes=n + 1) for n in range(4)}
        gains += against_always(choices, ["megabytes"], SUBJECTS, 1.0)["gains"].values()
    assert abs(np.mean(gains)) < 4 * np.std(gains) / np.sqrt(len(gains))
    assert min(gains) < -0.1


def test_trainings_of_one_method_stay_apart(tmp_path, write_manifest, run):
    """Two runs with other settings of one method: each is a choice, in any order of the runs."""
    other, rows = RunFolder(tmp_path / "other"), []
    for subject in SUBJECTS:
        frames = [("large", "1", 0, "novel_view", subject, "EMO", t, "a", "full") for t in range(2)]
        rows += [
            Row(*frame, metric, value, "p")
            for frame in frames
            for metric, value in (("psnr", 20.0), ("lpips", 0.2))
        ]
        avatar = ("large", "1", 0, "", subject, "", -1, "", "full")
        rows += [Row(*avatar, "storage", 0.5, ""), Row(*avatar, "training_time", 1.0, "")]
    Rows.of(rows).write(other.rows)
    write_manifest(other, METRICS, {"large": {"size": 1}}, {"novel_view": "p"})
    for folders in ((run, str(other.root)), (str(other.root), run)):
        found = recommend(RecommendSettings(folders, task="novel_view")).data["fitting"]
        assert len(found) == 3
        assert sorted(found.values()) == pytest.approx([20.0, 32.0, 33.0])


def test_seeds_of_separate_runs_count_together(tmp_path, write_manifest):
    """A training with two seeds, each in a run of its own: the mean of the qualities and the largest cost, in any order of the runs."""
    folders = []
    for seed, psnr, minutes in ((0, 30.0, 1.0), (1, 32.0, 3.0)):
        folder = RunFolder(tmp_path / f"seed-{seed}")
        rows = [row("a", "psnr", psnr, subject, seed=seed) for subject in SUBJECTS]
        rows += [avatar_row("a", "training_time", minutes, subject, seed=seed) for subject in SUBJECTS]
        Rows.of(rows).write(folder.rows)
        write_manifest(folder, METRICS[:1] + METRICS[3:], {"a": None}, {"novel_view": "h"}, seeds=(seed,))
        folders.append(str(folder.root))
    for order in (folders, folders[::-1]):
        found = recommend(RecommendSettings(tuple(order), task="novel_view")).data
        assert (found["quality"], found["costs"]) == (31.0, {"seconds": 180.0})


def test_choices_without_a_measured_cost_are_named(tmp_path, write_manifest):
    folder, rows = RunFolder(tmp_path / "run"), []
    for method in ("known", "unknown"):
        for index, subject in enumerate(SUBJECTS):
            frame = (method, "1", 0, "novel_view", subject, "EMO", 0, "a", "full")
            rows.append(Row(*frame, "psnr", 30.0, "p"))
            if method == "known" or index:
                avatar = (method, "1", 0, "", subject, "", -1, "", "full")
                rows.append(Row(*avatar, "training_time", 1.0, ""))
    Rows.of(rows).write(folder.rows)
    write_manifest(folder, METRICS[:1] + METRICS[3:], {"known": None, "unknown": None}, {"novel_view": "p"})
    result = asked(str(folder.root), seconds=100.0)
    assert list(result.data["fitting"]) == ["known"]
    assert "Left out: unknown: no measured seconds of 1 subject." in result.text


@pytest.mark.parametrize(
    ("machines", "says"),
    [
        (("A", "A"), ""),
        (
            ("A", "B"),
            "Frame time: Measured on A with 2 threads; B with 2 threads; values of different machines or thread counts are not comparable.",
        ),
        (("A", ""), ""),
    ],
)
def test_frame_times_of_several_machines_have_a_note(tmp_path, write_manifest, machines, says):
    """Runs of other subjects, each measured on a machine ("": not recorded)."""
    folders = [RunFolder(tmp_path / name) for name in ("first", "second")]
    time = MetricSpec("latency_p50", "p50", "ms", False, 2, "m:p50", kind="avatar", machine_bound=True)
    for folder, machine, subjects in zip(folders, machines, (SUBJECTS[:3], SUBJECTS[3:])):
        rows, place = [], {"machine": machine, "threads": 2} if machine else {}
        for method, subject in itertools.product(("fast", "slow"), subjects):
            rows.append(row(method, "psnr", 30.0, subject, protocol="p"))
            rows.append(avatar_row(method, "latency_p50", 5.0, subject, **place))
        Rows.of(rows).write(folder.rows)
        write_manifest(folder, [*METRICS[:1], time], {"fast": None, "slow": None}, {"novel_view": "p"})
    result = recommend(RecommendSettings(tuple(str(f.root) for f in folders), task="novel_view"))
    assert result.data["notes"] == [says] * bool(says)
    assert says in result.text


@pytest.mark.parametrize(("minutes", "fits"), [(2.0 * 1.04, True), (2.0 * 1.06, False)])
def test_a_training_with_a_limit_of_seconds_counts_with_it(tmp_path, write_manifest, minutes, fits):
    folder = RunFolder(tmp_path / "run")
    frame = ("timed", "1", 0, "novel_view", "s0", "EMO", 0, "a", "full")
    avatar = ("timed", "1", 0, "", "s0", "", -1, "", "full")
    rows = [Row(*frame, "psnr", 30.0, "p"), Row(*avatar, "training_time", minutes, "")]
    Rows.of(rows).write(folder.rows)
    write_manifest(folder, METRICS, {"timed": None}, {"novel_view": "p"})
    manifest = folder.read_manifest()
    (record,) = manifest.methods
    limited = replace(record, budget={"iterations": None, "seconds": 120.0})
    replace(manifest, methods=(limited,)).write(folder.manifest)
    if fits:
        assert asked(str(folder.root), seconds=120.0).data["costs"]["seconds"] == 120.0
        return
    with pytest.raises(InputError, match="timed nearest, with 127 s"):
        asked(str(folder.root), seconds=120.0)
