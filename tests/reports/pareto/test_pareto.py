"""``headbench report pareto`` on run folders with known rows."""

import csv
import itertools
import json
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

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.io.files import to_jsonable
from headbench.bench.rows import Row, Rows
from headbench.bench.specs import MetricSpec
from headbench.reports.aggregate import pareto_front
from headbench.reports.pareto.command import (
    COSTS,
    ParetoPoint,
    ParetoSettings,
    label_points,
    pareto_runs,
    write_plot,
)

METRICS = [
    MetricSpec("psnr", "PSNR", "dB", True, 2, "m:psnr"),
    MetricSpec("lpips", "LPIPS", "", False, 3, "m:lpips"),
    MetricSpec("storage", "Storage", "MB", False, 2, "m:storage", kind="avatar"),
    MetricSpec("fps", "Speed", "FPS", True, 1, "m:fps", kind="avatar"),
]


@pytest.fixture
def make_run(tmp_path, write_manifest):
    """A finished run; methods give (psnr, lpips, megabytes, frames per second)."""

    def make(name, protocol="p1", subject="s", **methods):
        folder = RunFolder(tmp_path / name)
        rows = []
        for method, (psnr, lpips, size, fps) in methods.items():
            for t, change in enumerate((-1.0, 1.0)):
                frame = (method, "1", 0, "novel_view", subject, "EMO", t, "a", "full")
                rows += [Row(*frame, "psnr", psnr + change, protocol), Row(*frame, "lpips", lpips, protocol)]
                if t == 0:  # a region is not seen in every frame
                    rows.append(Row(*frame[:-1], "face", "psnr", psnr - 10.0, protocol))
            avatar = (method, "1", 0, "", subject, "", -1, "", "full")
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
def test_runs_of_different_subjects_are_joined(make_run, tmp_path):
    parts = [
        make_run(name, subject=name, ours=(psnr, 0.1, 1.0, 200.0))
        for name, psnr in (("a", 28.0), ("b", 30.0))
    ]
    pareto_runs(ParetoSettings(tuple(parts), str(tmp_path / "out")))
    (point,) = table(tmp_path / "out")
    assert float(point["quality"]) == pytest.approx(29.0)
    other = make_run("c", subject="c", ga=(28.0, 0.1, 1.0, 200.0))
    with pytest.raises(InputError, match="methods"):
        pareto_runs(ParetoSettings((*parts, other), str(tmp_path / "other")))


@pytest.mark.usefixtures("no_plots")
def test_a_metric_where_less_is_better_turns_the_front_round(make_run, tmp_path):
    folder = make_run(
        "r", ours=(28.0, 0.10, 1.0, 200.0), ga=(27.0, 0.05, 2.0, 400.0), gbs=(30.0, 0.2, 3.0, 9.0)
    )
    pareto_runs(ParetoSettings((folder,), str(tmp_path / "out"), metric="lpips"))
    marks = {r["method"]: r["on_front_of_megabytes"] for r in table(tmp_path / "out")}
    assert marks == {"ours": "1", "ga": "1", "gbs": "0"}


@pytest.mark.usefixtures("no_plots")
def test_quality_may_be_that_of_a_region(make_run, tmp_path):
    run = make_run("run", ours=(28.0, 0.10, 1.0, 200.0))
    found = pareto_runs(ParetoSettings((run,), str(tmp_path / "out"), region="face"))
    (point,) = found.data["points"]
    assert (point["quality"], point["megabytes"]) == (18.0, 1.0)
    assert "PSNR of the face" in found.text
    with pytest.raises(InputError, match="one of face, full"):
        pareto_runs(ParetoSettings((run,), str(tmp_path / "out"), region="hat"))


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
