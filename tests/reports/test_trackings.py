"""``headbench report trackings`` on run folders with known rows."""

import csv
import io

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.reports import trackings
from headbench.reports.runs import RunData
from headbench.reports.trackings import Effects, TrackingsSettings, tracking_runs

VALUES = {"ga": (30.0, 26.0), "gbs": (28.0, 25.0), "mean-image": (20.0, 20.0)}


@pytest.fixture
def runs(write_run):
    """Two runs with these values."""
    folders = (
        write_run(name, {method: both[number] for method, both in VALUES.items()})
        for number, name in enumerate(("exact", "own"))
    )
    return tuple(map(str, folders))


def settings(runs, **changes):
    return TrackingsSettings(runs, **{"metrics": ("psnr",), "regions": ("full",), **changes})


def test_effects_and_remainder_add_up_to_the_values():
    values = np.random.default_rng(0).normal(size=(3, 4))
    effects = Effects.of(values)
    total = effects.mean + effects.methods[:, None] + effects.trackings + effects.remainder
    assert np.allclose(total, values)
    assert np.allclose([effects.methods.sum(), effects.trackings.sum()], 0)
    assert np.allclose(effects.remainder.sum(axis=0), 0)
    assert np.allclose(effects.remainder.sum(axis=1), 0)
    assert np.isclose(effects.shares.sum(), 1)
    assert not Effects.of(np.ones((2, 2))).shares.any()


def test_the_table_states_both_effects(runs):
    text = tracking_runs(settings(runs)).text
    lines = {line.split("  ")[0]: line.split() for line in text.splitlines() if line}
    assert lines["ga"] == ["ga", "30.0000", "26.0000", "4.0000", "+0.7500"]
    assert lines["mean-image"] == ["mean-image", "20.0000", "20.0000", "0.0000"]
    assert lines["mean"] == ["mean", "29.0000", "25.5000", "3.5000"]
    assert lines["due to tracking"] == ["due", "to", "tracking", "+1.7500", "-1.7500"]
    assert "Trackings differ by 3.5000 (83% of the variance), methods by 1.5000 (15%)" in text
    assert "remainder at most 0.2500 (2%)" in text


def test_conditions_of_one_run_are_trackings(write_run):
    run = write_run("one", {"ga": 30.0, "ga+tracked": 27.0})
    found = tracking_runs(settings((str(run),))).data[0]
    assert (found["trackings"], found["methods"]) == (("one", "one+tracked"), ("ga",))
    assert found["values"].tolist() == [[30.0, 27.0]]


def test_methods_without_a_value_are_not_in_the_effects(write_run):
    runs = str(write_run("a", {"ga": 30.0, "gbs": np.nan})), str(write_run("b", {"ga": 29.0, "gbs": 28.0}))
    found = tracking_runs(settings(runs))
    assert found.data[0]["chosen"] == (0,)
    (line,) = {line for line in found.text.splitlines() if line.startswith("gbs")}
    assert line.split() == ["gbs", "-", "28.0000", "-"]


def test_csv_has_a_line_for_each_value(runs):
    lines = [*csv.DictReader(io.StringIO(tracking_runs(settings(runs, format="csv")).text))]
    assert len(lines) == 2 * 3 * 2
    wanted = {"task": "novel_view", "region": "full", "metric": "psnr", "method": "ga", "tracking": "own"}
    assert wanted | {"value": "26.0"} in lines


def test_runs_that_differ_in_more_are_refused(write_run, make_run, runs):
    for other, found in (
        (write_run("fewer", {"ga": 30.0, "mean-image": 20.0}), "another gbs"),
        (write_run("set", dict.fromkeys(VALUES, 20.0), {"ga": {"a": 1}}), "another ga"),
    ):
        with pytest.raises(InputError, match=found):
            tracking_runs(settings((runs[0], str(other))))
    for changes, message in (
        ({"metrics": ("jod",)}, "--metrics.*jod"),
        ({"regions": ("nose",)}, "--regions.*nose"),
    ):
        with pytest.raises(InputError, match=message):
            tracking_runs(settings(runs, **changes))
    with pytest.raises(InputError, match="two trackings"):
        tracking_runs(settings(runs[:1]))
    with pytest.raises(InputError, match="each run once"):
        tracking_runs(settings((runs[0], runs[0])))
    folders = str(make_run("two")), str(make_run("one", subjects=("subject1",)))
    with pytest.raises(InputError, match="frames of novel_view.*0 more and"):
        tracking_runs(settings(folders, metrics=("error",)))


def test_captures_must_have_the_same_pictures(make_run, monkeypatch):
    folders = str(make_run("first")), str(make_run("second"))
    assert tracking_runs(settings(folders, metrics=("error",))).data[0]["trackings"] == ("first", "second")
    picture = RunData.ground_truth
    monkeypatch.setattr(
        trackings.RunData,
        "ground_truth",
        lambda run, key: picture(run, key) ^ np.uint8(run.folder.root.name == "second"),
    )
    with pytest.raises(InputError, match="(?s)mean difference of 1 levels.*--cut none"):
        tracking_runs(settings(folders, metrics=("error",)))
