"""``headbench report pareto`` on run folders with known rows."""

import csv
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image
from scipy import stats

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.io.files import to_jsonable
from headbench.bench.rows import Row, Rows
from headbench.bench.specs import MetricSpec
from headbench.reports.pareto.command import (
    COSTS,
    ParetoPoint,
    ParetoSettings,
    label_points,
    pareto_front,
    pareto_runs,
    rate_difference,
    write_plot,
)

STEPS = ("coded-x0.25", "coded-x0.5", "coded", "coded-x2")
RATE_METRICS = [
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
        write_manifest(folder, RATE_METRICS, labels, {"novel_view": "p1"})
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


METRICS = [
    MetricSpec("psnr", "PSNR", "dB", True, 2, "m:psnr"),
    MetricSpec("lpips", "LPIPS", "", False, 3, "m:lpips"),
    MetricSpec("storage", "Storage", "MB", False, 2, "m:storage", kind="avatar"),
    MetricSpec("fps", "Speed", "FPS", True, 1, "m:fps", kind="avatar"),
]


@pytest.fixture
def make_run(tmp_path, write_manifest):
    """A finished run; methods give (psnr, lpips, megabytes, frames per second)."""

    def make(name, protocol="p1", **methods):
        folder = RunFolder(tmp_path / name)
        rows = []
        for method, (psnr, lpips, size, fps) in methods.items():
            for t, change in enumerate((-1.0, 1.0)):
                frame = (method, "1", 0, "novel_view", "s", "EMO", t, "a", "full")
                rows += [Row(*frame, "psnr", psnr + change, protocol), Row(*frame, "lpips", lpips, protocol)]
                if t == 0:  # a region is not seen in every frame
                    rows.append(Row(*frame[:-1], "face", "psnr", psnr - 10.0, protocol))
            avatar = (method, "1", 0, "", "s", "", -1, "", "full")
            rows += [Row(*avatar, "storage", size, ""), Row(*avatar, "fps", fps, "")]
        named = [(each, each.method.partition("+")) for each in rows]
        Rows.of(
            replace(each, method=name, condition=condition) for each, (name, _, condition) in named
        ).write(folder.rows)
        write_manifest(folder, METRICS, dict.fromkeys(methods), {"novel_view": protocol}, trivial=("floor",))
        return str(folder.root)

    return make


def table(folder):
    with open(folder / "points.csv", newline="") as stream:
        return list(csv.DictReader(stream))


def test_points_of_several_runs_and_which_are_on_the_front(make_run, tmp_path):
    small = make_run("small", ours=(28.0, 0.10, 1.0, 200.0), ga=(27.0, 0.05, 2.0, 400.0))
    of_large = {"ours": (30.0, 0.04, 4.0, 50.0), "ga": (29.0, 0.06, 4.0, 100.0), "floor": (50.0, 0, 0.1, 1e4)}
    large = make_run("large", **of_large)
    found = pareto_runs(ParetoSettings((small, large), str(tmp_path / "out")))
    rows = {(r["run"].rsplit("/", 1)[-1], r["method"]): r for r in table(tmp_path / "out")}
    assert set(rows) == {("small", "ours"), ("small", "ga"), ("large", "ours"), ("large", "ga")}
    on_size = {key for key, r in rows.items() if r["on_front_of_megabytes"] == "1"}
    on_time = {key for key, r in rows.items() if r["on_front_of_milliseconds"] == "1"}
    assert on_size == {("small", "ours"), ("large", "ours")}
    assert on_time == set(rows)  # every faster one is worse
    assert float(rows["small", "ours"]["milliseconds"]) == pytest.approx(5.0)
    assert float(rows["small", "ours"]["quality"]) == pytest.approx(28.0)
    picture = np.asarray(Image.open(tmp_path / "out" / "pareto.png").convert("RGB"))
    # Steps of the front in each method's colour: a long horizontal line of it in either panel.
    for colour in ((0, 114, 178), (213, 94, 0)):
        own = (picture == colour).all(axis=2)
        half = own.shape[1] // 2
        assert max(own[:, :half].sum(1)) > 150
        assert max(own[:, half:].sum(1)) > 150
    assert found.passed


@pytest.mark.usefixtures("no_plots")
def test_a_metric_where_less_is_better_turns_the_front_round(make_run, tmp_path):
    folder = make_run(
        "r", ours=(28.0, 0.10, 1.0, 200.0), ga=(27.0, 0.05, 2.0, 400.0), gbs=(30.0, 0.2, 3.0, 9.0)
    )
    pareto_runs(ParetoSettings((folder,), str(tmp_path / "out"), metric="lpips"))
    marks = {r["method"]: r["on_front_of_megabytes"] for r in table(tmp_path / "out")}
    assert marks == {"ours": "1", "ga": "1", "gbs": "0"}


@pytest.mark.usefixtures("no_plots")
def test_what_does_not_compare_or_is_not_there_is_refused(make_run, tmp_path):
    one = make_run("one", ours=(28.0, 0.1, 1.0, 200.0))
    other = make_run("other", protocol="p2", ours=(28.0, 0.1, 1.0, 200.0))
    for folders, changes, message in (
        ((one, other), {}, "protocol"),
        ((one,), {"task": "extremes"}, "task"),
        ((one,), {"metric": "fps"}, "metric"),
        ((one,), {"time": "processor_time"}, "metric in ms: none"),
    ):
        with pytest.raises(InputError, match=message):
            pareto_runs(ParetoSettings(folders, str(tmp_path / "out"), **changes))
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_plots")
def test_frame_time_is_the_named_metric_or_else_the_median(make_run, tmp_path):
    folder = make_run("r", ours=(28.0, 0.1, 1.0, 200.0))
    manifest, rows = RunFolder(tmp_path / "r").manifest, RunFolder(tmp_path / "r").rows
    record, parts = json.loads(manifest.read_text()), [pd.read_parquet(rows)]
    for name, value in (("latency_p50", 4.0), ("processor_time", 9.0)):
        record["metrics"].append(to_jsonable(replace(METRICS[3], name=name, unit="ms")))
        parts.append(parts[0][parts[0]["metric"] == "fps"].assign(metric=name, value=value))
    manifest.write_text(json.dumps(record))
    Rows(pd.concat(parts, ignore_index=True)).write(rows)
    for time, expected in (("", 4.0), ("processor_time", 9.0)):
        pareto_runs(ParetoSettings((folder,), str(tmp_path / "out"), time=time))
        assert float(table(tmp_path / "out")[0]["milliseconds"]) == expected


@pytest.mark.usefixtures("no_plots")
@pytest.mark.parametrize(("time", "several"), [("", False), ("latency_p50", True)])
def test_frame_times_that_do_not_compare_have_a_note(make_run, tmp_path, change_manifest, time, several):
    methods = {"ours": (28.0, 0.1, 1.0, 200.0), "ga": (27.0, 0.1, 1.0, 9.0), "floor": (9.0, 0.9, 1.0, 9.0)}
    folders = [make_run(name, **methods) for name in ("r", "other")[: 1 + several]]
    for folder in folders:
        rows = pd.read_parquet(RunFolder(Path(folder)).rows)
        metric = {**to_jsonable(METRICS[3]), "name": time or "fps", "unit": "ms" if time else "FPS"}
        change_manifest(
            Path(folder), lambda m, new=metric: m["metrics"].__setitem__(3, new | {"machine_bound": True})
        )
        rows["metric"] = rows["metric"].replace("fps", time or "fps")
        own = rows["metric"] == (time or "fps")
        rows.loc[own, ["machine", "threads", "other_cores"]] = "A", 2, 0.0
        rows.loc[own & (rows["method"] == "ga"), "other_cores"] = 0.75
        rows.loc[own & (rows["method"] == "floor"), "threads"] = 1  # no point
        Rows(rows).write(RunFolder(Path(folder)).rows)
    found = pareto_runs(ParetoSettings(tuple(folders), str(tmp_path / "out"), time=time))
    names = ", ".join(f"ga of {folder}" for folder in folders) if several else "ga"
    note = f"{names}: Measured under load: other processes used up to 0.75 cores."
    assert found.data["note"] == note
    assert f"Frame times: {note}" in found.text.splitlines()


@pytest.mark.usefixtures("no_plots")
def test_derived_avatars_are_told_from_trained_ones(make_run, tmp_path):
    folder = make_run("r", **{"ga": (28.0, 0.1, 4.0, 100.0), "ga+half": (27.9, 0.1, 2.0, 100.0)})
    manifest = RunFolder(Path(folder)).read_manifest()
    conditions = (PLAIN, Condition("half", derive=Named("variant", {"name": "half"})))
    configuration = replace(manifest.configuration, conditions=conditions)
    replace(manifest, configuration=configuration).write(RunFolder(Path(folder)).manifest)
    text = pareto_runs(ParetoSettings((folder,), str(tmp_path / "out"))).text
    assert "derived from the trained avatar" in text
    trained, derived = table(tmp_path / "out")
    assert (trained["derived_from"], trained["variant"]) == ("", "")
    assert (derived["derived_from"], derived["variant"]) == ("ga", "half")


def point(variant="", quality=20.0, megabytes=1.0, milliseconds=None, method="ga"):
    return ParetoPoint("run", method, method, variant, quality, megabytes, milliseconds, "here")


def test_labels_touch_neither_points_nor_each_other():
    points = [*[point("half")] * 5, point("", 30.0, 10.0)]
    axes = Figure(dpi=200).subplots()
    axes.scatter([p.megabytes for p in points], [p.quality for p in points])
    axes.figure.draw_without_rendering()
    label_points(axes, points, "megabytes", range(5))
    boxes = [label.get_window_extent() for label in axes.texts]
    assert 2 <= len(boxes) < 5  # not every one has room
    marker = Bbox.from_bounds(*axes.transData.transform((1.0, 20.0)), 0, 0).padded(9)
    for one, other in itertools.combinations([*boxes, marker], 2):
        assert not one.overlaps(other)


def test_a_plot_without_measured_costs_is_drawn(tmp_path):
    write_plot(tmp_path / "plot.png", [point("$x", method="a$b_$")], COSTS, "PSNR", higher_is_better=True)
    width, height = Image.open(tmp_path / "plot.png").size
    assert width > 2 * height


SMALL = st.integers(0, 6)  # many ties


def beaten(point, others):
    return any(c <= point[0] and q >= point[1] and (c, q) != point for c, q in others)


@given(st.lists(st.tuples(SMALL, SMALL), max_size=25))
def test_the_front_is_what_no_other_point_beats(points):
    front = pareto_front([c for c, _ in points], [q for _, q in points])
    assert set(front) == {i for i, point in enumerate(points) if not beaten(point, points)}
    assert len(front) == len(set(front))
    assert [points[i][0] for i in front] == sorted(points[i][0] for i in front)
