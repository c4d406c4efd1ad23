"""``headbench report trackings`` on run folders with known rows."""

import csv
import io

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from headbench.reports import trackings
from headbench.reports.runs import RunData
from headbench.reports.trackings import Effects, TrackingsSettings, tracking_runs

VALUES = {"ga": (30.0, 26.0), "gbs": (28.0, 25.0), "mean-image": (20.0, 20.0)}


@pytest.fixture
def by_hand(write_run, monkeypatch):
    """Write runs by hand, without pictures of their frames."""
    monkeypatch.setattr(trackings, "with_common_frames", lambda runs: (runs, []))
    return lambda *given: str(write_run(*given))


@pytest.fixture
def runs(by_hand):
    """Two runs with these values."""
    folders = ("exact", "own")
    return tuple(
        by_hand(name, {method: both[number] for method, both in VALUES.items()})
        for number, name in enumerate(folders)
    )


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
    assert found["values"] == [[30.0, 27.0]]


def test_methods_without_a_value_are_not_in_the_effects(by_hand):
    runs = by_hand("a", {"ga": 30.0, "gbs": np.nan}), by_hand("b", {"ga": 29.0, "gbs": 28.0})
    found = tracking_runs(settings(runs))
    assert found.data[0]["chosen"] == (0,)
    assert found.data[0]["values"] == [[30.0, 29.0], [None, 28.0]]
    (line,) = {line for line in found.text.splitlines() if line.startswith("gbs")}
    assert line.split() == ["gbs", "-", "28.0000", "-"]
    runs = by_hand("c", {"ga": np.nan}), by_hand("d", {"ga": np.nan})
    assert tracking_runs(settings(runs)).text.startswith("Not measured: psnr.")


def test_csv_has_a_line_for_each_value(runs):
    lines = [*csv.DictReader(io.StringIO(tracking_runs(settings(runs, format="csv")).text))]
    assert len(lines) == 2 * 3 * 2
    wanted = {"task": "novel_view", "region": "full", "metric": "psnr", "method": "ga", "tracking": "own"}
    assert wanted | {"value": "26.0"} in lines


def test_cameras_seen_in_training_are_a_task(by_hand, monkeypatch):
    runs = by_hand("a", {"ga": 30.0}), by_hand("b", {"ga": 29.0})
    seen = frozenset((subject, "a") for subject in "ab"), ""
    monkeypatch.setattr(trackings, "unseen_cameras", lambda manifests, keys: seen)
    tasks = [each["task"] for each in tracking_runs(settings(runs)).data]
    assert tasks == ["novel_view", SEEN_CAMERAS, UNSEEN_CAMERAS]


def test_names_and_numbers_of_runs_are_checked(runs):
    for given, changes, message in (
        (runs, {"metrics": ("jod",)}, "--metrics.*jod"),
        (runs, {"regions": ("nose",)}, "--regions.*nose"),
        (runs[:1], {}, "two trackings"),
        (runs[:1] * 2, {}, "each run once"),
    ):
        with pytest.raises(InputError, match=message):
            tracking_runs(settings(given, **changes))


def test_runs_of_other_methods_or_protocols_are_refused(make_run, change_manifest):
    folders = [make_run("first"), make_run("second")]
    change_manifest(folders[1], lambda manifest: manifest["methods"][0]["budget"].update(iterations=3))
    with pytest.raises(InputError, match="another toy"):
        tracking_runs(settings(folders, metrics=("error",)))
    folders[1] = make_run("third", tasks=("novel_view",))
    with pytest.raises(InputError, match=r"protocols.*self_reenactment"):
        tracking_runs(settings(folders, metrics=("error",)))


def test_frames_are_matched_by_their_pictures(make_run, monkeypatch):
    folders = str(make_run("first")), str(make_run("second"))
    given = settings(folders, metrics=("error",))
    count = len(RunData.read(folders[0]).keys("novel_view"))
    picture, changed = RunData.ground_truth, set()

    def ground_truth(run, key):
        return picture(run, key) ^ np.uint8(run.folder.root.name == "second" and key in changed)

    monkeypatch.setattr(RunData, "ground_truth", ground_truth)
    plain = tracking_runs(given)
    assert plain.data[0]["trackings"] == ("first", "second")
    assert f"Novel view: {count} of {count} frames in all runs." in plain.text
    monkeypatch.setattr(trackings, "LEAST", 0.1)
    changed.add(RunData.read(folders[0]).keys("novel_view")[0])
    fewer = tracking_runs(given)
    assert f"Novel view: {count - 1} of {count} frames in all runs." in fewer.text
    assert plain.data[0]["values"] != fewer.data[0]["values"]
    monkeypatch.setattr(trackings, "LEAST", 1.0)
    with pytest.raises(InputError, match=f"pictures of novel_view.*{count - 1} of {count}"):
        tracking_runs(given)
