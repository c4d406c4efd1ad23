"""A sweep of toy avatars: rows of known levels, resumed and refused."""

from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.experiments import curve as module
from headbench.bench.experiments.curve import SweepSettings, sweep_run
from headbench.bench.io.documents import read_json
from headbench.bench.rows import ALL, Rows


@pytest.fixture
def subjects():
    return ("subject1", "subject2")


@pytest.fixture
def finished(toy, config, finished, monkeypatch):
    """The folder of a finished run of two methods, one of which has variants."""
    monkeypatch.setattr(module, "default_names", lambda group: ())
    methods = ("toy_plugin:METHOD", "toy_plugin:VARYING")
    metrics = ("toy_plugin:ERROR", "toy_plugin:FILES", "toy_plugin:STEPS")
    finished(replace(config, methods=methods, metrics=metrics))
    toy.MADE.clear()
    return Path(config.out)


def swept(run, **settings):
    """Table of the rows of a sweep."""
    sweep_run(SweepSettings(str(run), trust=True, metric="error", **settings))
    return (
        Rows.read(RunFolder(run / "sweep").rows)
        .labelled()
        .select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    )


def test_variants_are_scored_like_the_run_itself(finished, toy):
    rows = swept(finished)
    errors = rows[(rows["metric"] == "error") & (rows["subject"] == "subject2") & (rows["timestep"] == 2)]
    # Rendered level 255 times the grey, against 40 + 20 + 1.
    found = dict(zip(errors["method"], errors["value"]))
    assert found == {"varying": 128 - 61, "varying+dark": 64 - 61, "varying+light": 191 - 61}
    assert set(rows["metric"]) == {"error", "files"}  # nothing was trained: no metric of training
    record, original = (read_json(RunFolder(path).manifest) for path in (finished / "sweep", finished))
    assert record["protocols"]["novel_view"] == original["protocols"]["novel_view"]
    assert [entry.get("condition", "") for entry in record["methods"]] == ["", "dark", "light"]
    assert record["configuration"]["conditions"][1]["derive"] == {
        "name": "variant",
        "parameters": {"name": "dark"},
    }


def test_only_the_named_variants_and_frames_are_measured(finished, toy):
    rows = swept(finished, variants=("light",), frames=1)
    assert set(rows["method"]) == {"varying", "varying+light"}
    assert set(toy.MADE) == {0.75}
    assert (rows[rows["metric"] == "error"].groupby(["method", "subject", "task"]).size() == 1).all()


def test_a_second_sweep_measures_nothing_again_or_is_another(finished, toy, monkeypatch):
    first = swept(finished)
    monkeypatch.setattr(toy, "files_in_avatar", lambda *arguments: pytest.fail("measured again"))
    assert swept(finished).equals(first)
    with pytest.raises(InputError, match="configuration.conditions.dark: expected name dark.*, found none"):
        swept(finished, variants=("light",))


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"methods": ("toy",)}, "methods that derive variants"),
        ({"methods": ("varying", "toy")}, "methods that derive variants, found toy"),
        ({"variants": ("drak",)}, "a variant of these methods"),
    ],
)
def test_what_cannot_be_derived_is_refused_before_work(finished, toy, settings, match):
    with pytest.raises(InputError, match=match):
        swept(finished, **settings)
    assert toy.MADE == []
