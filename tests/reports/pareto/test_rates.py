"""Differences of rates against closed forms, and curves of runs with known rows."""

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy import stats

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.rows import Row, Rows
from headbench.bench.specs import MetricSpec
from headbench.reports.pareto.command import ParetoSettings, pareto_runs, rate_difference

STEPS = ("coded-x0.25", "coded-x0.5", "coded", "coded-x2")
METRICS = [
    MetricSpec("psnr", "PSNR", "dB", True, 2, "m:psnr"),
    MetricSpec("lpips", "LPIPS", "", False, 3, "m:lpips"),
    MetricSpec("storage", "Storage", "MB", False, 2, "m:storage", kind="avatar"),
]


def curve(shift=0.0, factor=1.0, qualities=(30.0, 31.0, 33.0, 36.0)):
    """Exponential growth of the rate with quality, shifted in quality and scaled in rate."""
    return [(factor * math.exp(0.3 * quality), quality + shift) for quality in qualities]


@given(st.floats(0.2, 5), st.floats(-1, 1))
def test_scaled_and_shifted_curves_differ_in_closed_form(factor, shift):
    """ln R is linear in quality, where the interpolation is exact: a shift by s costs exp(-0.3 s)."""
    found = rate_difference(curve(), curve(shift, factor))
    assert found == pytest.approx(math.log(factor) - 0.3 * shift, abs=1e-9)
    assert rate_difference(curve(shift, factor), curve()) == pytest.approx(-found, abs=1e-12)


def test_only_common_qualities_count():
    """A curve with twice the rate below 33 and an equal one above differs by what is below, as both are cut there."""
    low, high = (30.0, 31.0, 32.0, 33.0), (33.0, 34.0, 35.0, 36.0)
    assert rate_difference(curve(), curve(factor=2, qualities=low)) == pytest.approx(math.log(2))
    assert rate_difference(curve(), curve(qualities=high)) == pytest.approx(0, abs=1e-9)
    assert rate_difference(curve(qualities=low), curve(qualities=high)) is None  # they share one point


def test_lower_is_better_is_the_mirror_image():
    mirrored = [(size, -quality) for size, quality in curve(factor=1.5)]
    plain = [(size, -quality) for size, quality in curve()]
    found = rate_difference(plain, mirrored, higher_is_better=False)
    assert found == pytest.approx(math.log(1.5))


def test_points_that_another_beats_do_not_count():
    beaten = [*curve(), (math.exp(0.3 * 34), 30.5)]
    assert rate_difference(curve(), beaten) == pytest.approx(0, abs=1e-9)
    assert rate_difference(curve(), curve()[:2]) is None


@pytest.fixture
def coded_run(tmp_path, write_manifest):
    """A run whose method "wide" takes twice the bytes of "slim" at equal quality, but for a factor by subject."""

    def make(factors=(1.0, 1.0, 1.0, 1.0), steps=STEPS, name="run", subjects="abcd", seed=0):
        folder, rows, labels = RunFolder(tmp_path / name), [], {}
        conditions = (PLAIN, *(Condition(step, derive=Named("variant", {"name": step})) for step in steps))
        for method, base in (("slim", 1.0), ("wide", 2.0)):
            for number, condition in enumerate(("", *steps)):
                labels[f"{method}+{condition}" if condition else method] = None
                for subject, factor in zip(subjects, factors):
                    size = (
                        base * (factor if method == "wide" else 1) * (40 if not condition else 2.0**-number)
                    )
                    quality = 36.0 - (0 if not condition else 0.5 * number)
                    frame = (method, "1", seed, "novel_view", subject, "EMO", 1, "cam", "full")
                    avatar = (method, "1", seed, "", subject, "", -1, "", "full")
                    rows += [
                        replace(row, condition=condition)
                        for row in (
                            Row(*frame, "psnr", quality, "p1"),
                            Row(*frame, "lpips", 1 - quality / 100, "p1"),
                            Row(*avatar, "storage", size, ""),
                        )
                    ]
        Rows.of(rows).write(folder.rows)
        write_manifest(folder, METRICS, labels, {"novel_view": "p1"})
        manifest = folder.read_manifest()
        source = replace(manifest.configuration, conditions=conditions)
        replace(manifest, configuration=source).write(folder.manifest)
        return str(folder.root)

    return make


def test_a_report_has_curves_and_differences(coded_run, tmp_path):
    out = tmp_path / "out"
    result = pareto_runs(ParetoSettings((coded_run(),), str(out)))
    for rate in result.data["rates"]:
        assert (rate["method"], rate["reference"], rate["subjects"]) == ("wide", "slim", 4)
        # Equal factors of all subjects leave no variation, hence an interval of one point.
        for name in ("percent", "low", "high"):
            assert rate[name] == pytest.approx(100)
    assert {rate["metric"] for rate in result.data["rates"]} == {"psnr", "lpips"}
    assert "BD-rate by psnr, wide against slim: +100.0 %" in result.text
    with Image.open(out / "rate_distortion.png") as image:
        assert image.size[0] > 1000
    with (out / "rates.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 2 * 4 * (1 + len(STEPS))


@pytest.mark.usefixtures("no_plots")
def test_the_interval_covers_the_mean_of_subjects(coded_run, tmp_path):
    factors = (0.8, 1.0, 1.1, 1.3)
    settings = ParetoSettings((coded_run(factors),), str(tmp_path / "out"), reference="slim")
    rate = pareto_runs(settings).data["rates"][0]
    mean = 100 * (2 * math.exp(np.mean(np.log(factors))) - 1)
    assert rate["percent"] == pytest.approx(mean)
    logarithms = np.log(2 * np.array(factors))
    bounds = stats.t.interval(0.95, 3, loc=logarithms.mean(), scale=stats.sem(logarithms))
    assert (rate["low"], rate["high"]) == pytest.approx(tuple(100 * np.expm1(bounds)))


@pytest.mark.usefixtures("no_plots")
def test_runs_of_single_subjects_are_those_of_one_run_of_all(coded_run, tmp_path):
    factors = (0.8, 1.0, 1.1, 1.3)
    whole = pareto_runs(ParetoSettings((coded_run(factors),), str(tmp_path / "whole")))
    parts = tuple(coded_run((factor,), name=each, subjects=each) for each, factor in zip("abcd", factors))
    joined = pareto_runs(ParetoSettings(parts, str(tmp_path / "joined")))
    assert joined.data["rates"] == whole.data["rates"]
    assert (tmp_path / "joined" / "rates.csv").read_bytes() == (tmp_path / "whole" / "rates.csv").read_bytes()
    other = coded_run(name="e", subjects="e", steps=STEPS[:2])
    with pytest.raises(InputError, match="methods"):
        pareto_runs(ParetoSettings((*parts, other), str(tmp_path / "other")))


@pytest.mark.usefixtures("no_plots")
def test_two_trainings_of_a_subject_have_two_curves(coded_run, tmp_path):
    runs = (coded_run(), coded_run((1.5,) * 4, name="again"))
    result = pareto_runs(ParetoSettings(runs, str(tmp_path / "out")))
    found = {rate["method"]: round(rate["percent"]) for rate in result.data["rates"]}
    assert found == {"wide (run)": 100, "wide (again)": 200}  # slim, equal in both, has one


@pytest.mark.usefixtures("no_plots")
def test_other_seeds_of_a_training_have_no_curves(coded_run, tmp_path):
    runs = (coded_run(), coded_run((1.5,) * 4, name="again", seed=1))
    result = pareto_runs(ParetoSettings(runs, str(tmp_path / "out")))
    assert result.data["rates"] == []
    assert "expected the values of wide in another run" in result.text


@pytest.mark.usefixtures("no_plots")
def test_too_few_steps_have_no_difference(coded_run, tmp_path):
    one = pareto_runs(ParetoSettings((coded_run(steps=("coded",)),), str(tmp_path / "one")))
    assert one.data["rates"] == []
    assert not (Path(tmp_path) / "one" / "rates.csv").exists()
    two = pareto_runs(ParetoSettings((coded_run(steps=STEPS[:2]),), str(tmp_path / "two")))
    assert {rate["percent"] for rate in two.data["rates"]} == {None}
    assert "none (4 of 4 subjects" in two.text
    with pytest.raises(InputError, match="--reference"):
        pareto_runs(ParetoSettings((coded_run(),), str(tmp_path / "out"), reference="broad"))
