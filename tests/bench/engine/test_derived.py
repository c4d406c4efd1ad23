"""Avatars derived from those of the same run: their order, what a kill leaves, what a failed training means for them."""

from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.engine import run as runner
from headbench.bench.engine.run import planned_cells
from headbench.bench.engine.store import RunFolder
from headbench.bench.rows import ALL

DARK = Condition("dark", ("varying",), derive=Named("variant", {"name": "dark"}))


@pytest.fixture
def deriving(config, toy):
    toy.MADE.clear()
    # The condition is named first, so that the order of the cells is not that of the settings.
    return replace(config, methods=("toy_plugin:VARYING", "toy_plugin:METHOD"), conditions=(DARK, PLAIN))


def table(rows):
    return rows.labelled().select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)


def qualities(rows, label):
    own = table(rows)
    return own[(own["method"] == label) & (own["metric"] == "psnr")]


def test_derived_cells_follow_all_trainings(deriving, toy):
    labels = [name.partition(",")[0] for name in planned_cells(deriving)]
    assert labels.index("varying+dark") > max(labels.index(name) for name in ("varying", "toy"))
    rows = runner.run(deriving).rows
    assert len(toy.FITS) == 2
    assert set(qualities(rows, "varying+dark")["status"]) == {"ok"}
    other = Path(deriving.out) / "trained"
    dark = runner.run(
        replace(deriving, out=str(other), conditions=(PLAIN,), settings={"varying": {"level": 0.25}})
    ).rows
    assert qualities(rows, "varying+dark")["value"].tolist() == qualities(dark, "varying")["value"].tolist()
    codecs = {method.label: method.codec for method in RunFolder(Path(deriving.out)).read_manifest().methods}
    assert codecs == dict.fromkeys(("varying+dark", "varying", "toy"), "")


def test_a_run_killed_before_it_derives_continues(deriving, toy, monkeypatch):
    def killed(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("headbench.bench.engine.cell.derive", killed)
        with pytest.raises(KeyboardInterrupt):
            runner.run(deriving)
    trained = len(toy.FITS)
    rows = runner.run(deriving).rows
    assert len(toy.FITS) == trained
    assert set(qualities(rows, "varying+dark")["status"]) == {"ok"}
    made = len(toy.MADE)
    runner.run(deriving)
    assert len(toy.MADE) == made  # what is finished stays


def test_a_failed_training_fails_what_is_derived(deriving, toy):
    failing = replace(deriving, settings={"varying": {"fail": True}})
    rows = runner.run(failing).rows
    derived = qualities(rows, "varying+dark")
    assert set(derived["status"]) == {"failed"}
    assert derived["reason"].str.contains("expected a trained avatar").all()
    assert set(qualities(rows, "toy")["status"]) == {"ok"}
