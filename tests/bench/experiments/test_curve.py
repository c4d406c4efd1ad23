"""Curves over ball captures and over a tiny capture: what is trained on, measured, resumed and refused."""

import csv
import importlib
import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from headbench.bench.condition import Condition, part_of_text
from headbench.bench.contracts import Budget
from headbench.bench.engine import run as runner
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import HeadbenchError, InputError
from headbench.bench.experiments import curve as module
from headbench.bench.experiments.curve import CurveSettings, curve_run
from headbench.bench.experiments.held_out import hold_out
from headbench.datasets.synthetic.capture import synthesize
from headbench.reports.curve import curve as report
from headbench.reports.curve.curve import MEASURED, CurveReportSettings, curve_runs

from ...datasets.flat_renderer import flat_pictures
from ...world import run_on

TESTS = Path(__file__).parents[2]
HELD_TIMESTEP, HELD_CAMERA = 2, "1"  # of timesteps 0 to 3, and of cameras at -60, -30, 30 and 60 degrees


@pytest.fixture
def plugin(monkeypatch):
    """The methods that take note, importable by name, and the reader of ball captures."""
    for folder in ("bench/experiments", "reports/robustness", "bench"):
        monkeypatch.syspath_prepend(TESTS / folder)
    monkeypatch.setattr(runner, "write_reports", lambda folder: [])
    monkeypatch.setattr(module, "METRICS", ("psnr", "storage"))
    monkeypatch.setattr(report, "write_plot", lambda path, *args: path.touch())
    found = importlib.import_module("curve_plugin")
    found.FITS.clear()
    found.POSES.clear()
    found.RENDERED.clear()
    monkeypatch.setattr(found.Method, "killed", ())
    return found


@pytest.fixture
def make_run(plugin, run_of):
    """A finished run of methods on one ball or more."""

    def make(*methods, subjects=("ball-a",), **where):
        run = run_of(*methods, subjects=subjects, **where)
        plugin.FITS.clear()
        plugin.RENDERED.clear()
        return run

    return make


def settings(run, **changes):
    return CurveSettings(str(run), trust=True, **{"executor": "inline", **changes})


def table(run):
    with open(run / "curve" / "curve.csv", newline="") as stream:
        return list(csv.DictReader(stream))


def quality_rows(curve):
    """Rows without what trainings took, which differs between two trainings."""
    rows = pd.read_parquet(curve / "rows.parquet")
    return rows[~rows["metric"].isin(module.COSTS)].reset_index(drop=True)


def test_held_out_frames_alone_are_measured_and_never_trained_on(make_run, plugin):
    curve_run(settings(make_run("curve_plugin:METHOD"), fractions=("1", "1/4")))
    assert [budget for _, budget in plugin.FITS] == [Budget(64), Budget(16)]
    for train, _ in plugin.FITS:
        assert {(key.timestep, key.camera) for key in train} == {(t, c) for t in (0, 1, 3) for c in "034"}
    held_camera = {(t, HELD_CAMERA) for t in (0, 1, 3)}
    held_timesteps = {(HELD_TIMESTEP, camera) for camera in "0134"}
    assert set(plugin.RENDERED) == held_camera | held_timesteps


def test_a_clip_gives_no_test_frame(plugin, tmp_path):
    clip = importlib.import_module("ball_plugin").BallClip(tmp_path / "ball-a")
    held = hold_out(clip)
    assert held.fingerprint not in (clip.fingerprint, hold_out(clip, camera="0").fingerprint)
    for key in clip.splits["novel_view"] + clip.splits["self_reenactment"]:
        for read in (held.image, held.mask):
            with pytest.raises(HeadbenchError, match="no training frame"):
                read(key)


def test_code_outside_that_looks_at_a_test_frame_fails(make_run):
    run = make_run("curve_plugin:METHOD", "curve_plugin:PEEKING")
    findings = curve_run(settings(run, fractions=("1",)))
    assert not findings.passed
    assert findings.data["failed"] == ["peeking+1"]
    assert "failed: peeking+1" in findings.text
    values = {line["method"]: line["psnr_camera"] for line in table(run)}
    assert values["noting"]
    assert not values["peeking"]


@pytest.mark.parametrize(
    ("over", "seen"),
    [
        # Of the cameras at -60, 30 and 60 degrees the one in the middle comes first, then the one farthest from it.
        ("cameras", [{(t, c) for t in (0, 1, 3) for c in cameras} for cameras in ("034", "03", "3")]),
        ("timesteps", [{(t, c) for t in steps for c in "034"} for steps in ((0, 1, 3), (0, 3), (1,))]),
    ],
)
def test_less_to_train_on_is_measured_on_the_same_frames(make_run, plugin, over, seen):
    run = make_run("curve_plugin:METHOD")
    fractions = ("1", "2/3", "0.6", "0.01")  # two of them are the same number of cameras or timesteps
    findings = curve_run(settings(run, over=over, fractions=fractions))
    trained = [
        ({(key.timestep, key.camera) for key in train}, budget.iterations) for train, budget in plugin.FITS
    ]
    assert trained == [(keys, 64) for keys in seen]
    measured = {(t, HELD_CAMERA) for t in (0, 1, 3)} | {(HELD_TIMESTEP, camera) for camera in "0134"}
    assert sorted(plugin.RENDERED) == sorted([*measured] * 3)
    assert [point[over] for point in findings.data["points"]] == [1, 2, 3]


def test_pictures_are_counted_over_timesteps_and_cameras(make_run, plugin):
    run = make_run("curve_plugin:METHOD")
    findings = curve_run(settings(run, over="pictures", pictures=(1, 4, 30)))
    trained = [{(key.timestep, key.camera) for key in train} for train, _ in plugin.FITS]
    assert [len(keys) for keys in trained] == [9, 4, 1]
    assert trained[2] == {(1, "3")}  # the timestep and the camera in the middle
    assert {timestep for timestep, _ in trained[1]} == {0, 1, 3}
    assert {camera for _, camera in trained[1]} == set("034")
    points = [(point["pictures"], point["timesteps"]) for point in findings.data["points"]]
    assert points == [(1, 1), (4, 3), (9, 3)]
    plugin.FITS.clear()
    findings = curve_run(settings(run, over="seconds", seconds=(0.5, 2)))
    assert [budget for _, budget in plugin.FITS] == [Budget(None, 2.0), Budget(None, 0.5)]
    points = [(point["budget_seconds"], point["fraction"]) for point in findings.data["points"]]
    assert points == [(0.5, 1.0), (2.0, 1.0)]


@pytest.mark.commands
def test_tracking_error_changes_poses_alone(plugin, tmp_path):
    capture = tmp_path / "capture"
    with flat_pictures():
        synthesize(capture, cameras=3, timesteps=8, size=(16, 16), workers=1)
    (union,) = capture.glob("UNION*")
    run_on(union, tmp_path / "run", "curve_plugin:METHOD")
    plugin.FITS.clear()
    plugin.POSES.clear()
    of_errors = {"over": "tracking_error", "frames": 1}
    findings = curve_run(settings(tmp_path / "run", levels=(0.0, 2.0), **of_errors))
    assert [point["tracking_error"] for point in findings.data["points"]] == [0.0, 2.0]
    exact, wrong = plugin.POSES
    assert exact.keys() == wrong.keys()
    assert any((exact[t].expression != wrong[t].expression).any() for t in exact)
    made = tmp_path / "run" / "curve-tracking-error" / "capture-tracking-2"
    for picture in capture.rglob("*.png"):
        assert (made / picture.relative_to(capture)).samefile(picture)


def test_a_row_for_each_method_subject_and_part(make_run, plugin):
    run = make_run("curve_plugin:METHOD", "curve_plugin:TIMED", subjects=("ball-a", "ball-bee"))
    findings = curve_run(settings(run, fractions=("1", "1/4")))
    assert [(line["method"], line["subject"], line["fraction"]) for line in table(run)] == [
        (method, subject, part)
        for method in ("noting", "timed")
        for part in ("0.25", "1.0")
        for subject in ("ball-a", "ball-bee")
    ]
    assert {line["budget_seconds"] for line in table(run)} == {"", "2.0", "8.0"}
    record = RunFolder(run / "curve").cell("ball-a", "noting+1-4", 0).record
    assert record["method"]["budget"]["iterations"] == 16
    first = table(run)[0]
    assert [float(first[name]) for name in MEASURED] == pytest.approx(
        [record["training"][name] for name in MEASURED]
    )
    rows = quality_rows(run / "curve")
    own = rows[
        (rows["condition"] == "1-4")
        & (rows["method"] == "noting")
        & (rows["subject"] == "ball-a")
        & (rows["metric"] == "psnr")
    ]
    by_task = own.groupby("task")["value"].mean()
    assert float(first["psnr_camera"]) == pytest.approx(by_task["novel_view"])
    assert float(first["psnr_timesteps"]) == pytest.approx(by_task["self_reenactment"])
    assert re.search(r"noting +1/4 +16 ", findings.text)


def test_a_kill_half_way_ends_with_the_same_rows(make_run, plugin, monkeypatch):
    run, parts = make_run("curve_plugin:METHOD"), ("1", "1/4", "1/16")
    curve_run(settings(run, out=str(run.parent / "whole"), fractions=parts))
    plugin.FITS.clear()
    monkeypatch.setattr(plugin.Method, "killed", (16,))
    with pytest.raises(KeyboardInterrupt):
        curve_run(settings(run, fractions=parts))
    monkeypatch.setattr(plugin.Method, "killed", ())
    assert RunFolder(run / "curve").read_manifest().status != "done"
    curve_run(settings(run, fractions=parts))
    # The one that was killed begins again, so that its time is that of the whole training.
    assert [budget.iterations for _, budget in plugin.FITS] == [64, 16, 16, 4]
    assert quality_rows(run / "curve").equals(quality_rows(run.parent / "whole"))
    assert all(float(line["processor_seconds"]) >= 0 for line in table(run))
    curve_run(settings(run, fractions=parts))
    assert len(plugin.FITS) == 4


def test_the_held_out_camera_and_timesteps_can_be_chosen(make_run, plugin):
    run = make_run("curve_plugin:METHOD")
    findings = curve_run(settings(run, fractions=("1",), camera="4", every=2))
    held = findings.data["held_out"]["ball-a"]
    assert (held["camera"], held["timesteps"]) == ("4", [1, 3])
    ((train, _),) = plugin.FITS
    assert {(key.timestep, key.camera) for key in train} == {(t, c) for t in (0, 2) for c in "013"}
    with pytest.raises(InputError, match="parameters.camera, .* choose another --out"):
        curve_run(settings(run, fractions=("1",)))


def test_test_frames_are_scored_by_camera_where_asked_for(make_run, plugin):
    findings = curve_run(settings(make_run("curve_plugin:METHOD"), fractions=("1",), test=True))
    ((train, _),) = plugin.FITS
    assert {(key.timestep, key.camera) for key in train} == {(t, c) for t in range(4) for c in "0134"}
    assert set(plugin.RENDERED) == {(t, "2") for t in range(4)} | {(t, c) for t in (4, 5) for c in "01234"}
    (point,) = findings.data["points"]
    seen, unseen = (point[f"psnr_expressions_{name}"] for name in ("seen", "unseen"))
    assert seen == pytest.approx(unseen)  # a ball frame is as bright in all cameras
    assert "Test frames of the captures." in findings.text


def test_the_face_is_measured_where_captures_have_it(make_run, monkeypatch):
    ball = importlib.import_module("ball_plugin")
    masks = {"face": np.arange(ball.SIZE[0] * ball.SIZE[1]).reshape(ball.SIZE[::-1]) > 60}
    monkeypatch.setattr(ball.BallClip, "region_names", ("face",), raising=False)
    monkeypatch.setattr(ball.BallClip, "region_masks", lambda clip, key, names: masks, raising=False)
    (point,) = curve_run(settings(make_run("curve_plugin:METHOD"), fractions=("1",))).data["points"]
    assert point["psnr_face_camera"] == pytest.approx(point["psnr_camera"])  # grey on grey
    assert point["psnr_face_timesteps"] == pytest.approx(point["psnr_timesteps"])


def test_parts_may_be_of_another_number_of_iterations(make_run, plugin):
    run = make_run("curve_plugin:METHOD")
    curve_run(settings(run, fractions=("1/4", "1"), iterations=("noting=400",)))
    assert [budget for _, budget in plugin.FITS] == [Budget(400), Budget(100)]
    with pytest.raises(InputError, match="NAME=NUMBER"):
        settings(run, iterations=("noting",))


@pytest.mark.parametrize("over", ["budget", "seconds"])
def test_a_curve_ends_where_a_longer_training_is_worse(make_run, plugin, over):
    """Renders get brighter with the length, and all frames are dark."""
    run = make_run("curve_plugin:METHOD")
    lengths = {"fractions": ("1/16", "1/4", "1")} if over == "budget" else {"seconds": (4.0, 16.0, 64.0)}
    asked = settings(run, over=over, until_flat=True, **lengths)
    findings = curve_run(asked)
    assert [budget.iterations or budget.seconds for _, budget in plugin.FITS] == [4, 16]
    assert len(findings.data["points"]) == 2
    curve_run(asked)
    assert len(plugin.FITS) == 2
    joined = curve_runs(CurveReportSettings((str(findings.data["out"]),), str(run / "joined"), over))
    assert [p["psnr_camera"] for p in joined.data["points"]] == [
        p["psnr_camera"] for p in findings.data["points"]
    ]


@pytest.mark.parametrize(
    ("splits", "asked", "match"),
    [
        (("train",), {"test": True}, "--test: expected captures with test frames"),
        (("train", "novel_view"), {"test": True, "until_flat": True}, "--until-flat: .* novel_view alone"),
    ],
)
def test_missing_frames_are_noticed_before_a_training(make_run, plugin, monkeypatch, splits, asked, match):
    run = make_run("curve_plugin:METHOD")
    made = module.hold_out

    def without(clip, *args, **how):
        held = made(clip, *args, **how)
        return replace(held, splits={name: held.splits[name] for name in splits})

    monkeypatch.setattr(module, "hold_out", without)
    with pytest.raises(InputError, match=match):
        curve_run(settings(run, **asked))
    assert not plugin.FITS


def test_a_folder_has_one_run_or_one_for_each_part(make_run, plugin):
    run = make_run("curve_plugin:METHOD")
    for kind, other in ((True, False), (False, True)):
        where = {"out": str(run / f"curve-{kind}"), "fractions": ("1",)}
        curve_run(settings(run, until_flat=kind, **where))
        with pytest.raises(InputError, match="--out: expected a new folder"):
            curve_run(settings(run, until_flat=other, **where))
    assert len(plugin.FITS) == 2


def test_iterations_are_of_methods_that_are_trained(make_run, plugin):
    run = make_run("curve_plugin:METHOD", "curve_plugin:TIMED")
    with pytest.raises(
        InputError, match="--iterations: expected methods that are trained: timed, found noting"
    ):
        curve_run(settings(run, methods=("timed",), iterations=("noting=100",)))
    assert not plugin.FITS


@pytest.fixture
def joined(make_run, tmp_path):
    """Joins curves of two subjects, the second with other settings."""

    def join(**changes):
        places = []
        for subject, how in (("ball-a", {}), ("ball-bee", changes)):
            run = make_run("curve_plugin:METHOD", subjects=(subject,), folder=tmp_path / subject)
            curve_run(settings(run, **{"fractions": ("1", "1/4"), **how}))
            places.append(str(run / "curve"))
        return curve_runs(CurveReportSettings(tuple(places), str(tmp_path / "joined")))

    return join


def test_no_mean_is_over_trainings_of_other_lengths(joined):
    with pytest.raises(InputError, match=r"budget of noting\+1: expected .*64.*, found .*4000"):
        joined(iterations=("noting=4000",))


def test_parts_that_a_subject_lacks_are_named(joined):
    text = joined(fractions=("1", "1/8")).text
    assert re.findall("left out: (.*)", text) == [
        f"noting {part}, trained on 1 of 2 subjects" for part in ("1/8", "1/4")
    ]


def test_with_one_camera_timesteps_alone_are_held_out(plugin, tmp_path):
    clip = importlib.import_module("ball_plugin").BallClip(tmp_path / "ball-a")
    clip.splits["train"] = tuple(key for key in clip.splits["train"] if key.camera == "3")
    held = hold_out(clip)
    assert "novel_view" not in held.splits
    assert [key.timestep for key in held.splits["self_reenactment"]] == [HELD_TIMESTEP]
    with pytest.raises(InputError, match="frames to train with"):
        hold_out(clip, camera="3")


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"fractions": ("0",)}, "above 0 and at most 1"),
        ({"fractions": ("0.5", "1/2")}, "each once"),
        ({"over": "tracking_error", "levels": (4.5,)}, "from 0 to 4"),
        ({"over": "seconds", "seconds": (1e6,)}, "below 1,000,000"),
        ({"over": "seconds", "seconds": (30.0, 30.0000001)}, "six digits"),
        ({"every": 1}, "at least 2"),
    ],
)
def test_settings_out_of_range_are_refused(changes, match):
    with pytest.raises(ValueError, match=match):
        CurveSettings("run", **changes)


@pytest.mark.parametrize("text", ["1/3", "0.25", "0.333333", "0.123456789012", "0.123456789012/999999"])
def test_a_part_is_known_as_it_is_written_after_reduction(text):
    assert Condition("part", budget=str(Condition("part", budget=text).part)).part == part_of_text(
        text, "fractions"
    )


REFUSED = [
    ({}, "budget of endless: expected iterations or seconds"),
    ({"methods": ("notng",)}, "methods of the run: noting, endless"),
    ({"methods": ("noting",), "camera": "2"}, "a training camera: 0, 1, 3, 4"),
    ({"methods": ("noting",), "over": "tracking_error"}, "expected a synthetic capture"),
]


def test_what_cannot_be_trained_is_refused_before_work(make_run, plugin):
    run = make_run("curve_plugin:METHOD", "curve_plugin:ENDLESS")
    for changes, match in REFUSED:
        with pytest.raises(InputError, match=match):
            curve_run(settings(run, **changes))
    assert plugin.FITS == []
    folder = RunFolder(run)
    replace(folder.read_manifest(), status="started").write(folder.manifest)
    with pytest.raises(InputError, match="expected 'done'"):
        curve_run(settings(run, out=str(run.parent / "other")))
    assert not (run.parent / "other").exists()


def test_points_that_are_there_are_kept(make_run, plugin):
    run = make_run("curve_plugin:METHOD", "curve_plugin:TIMED")
    whole = {"fractions": ("1", "1/4")}
    curve_run(settings(run, **whole))
    before = table(run)
    curve_run(settings(run, **whole))
    assert table(run) == before
    assert len(plugin.FITS) == 4
    with pytest.raises(InputError, match="configuration.methods, .* choose another --out"):
        curve_run(settings(run, methods=("noting",), fractions=("1",)))
    with pytest.raises(InputError, match="one of a curve"):
        curve_run(settings(run / "curve"))


@pytest.mark.commands
def test_curves_of_several_subjects_and_methods_are_joined(make_run, tmp_path):
    methods, subjects = ("curve_plugin:METHOD", "curve_plugin:TIMED"), ("ball-a", "ball-bee")
    whole = curve_run(settings(make_run(*methods, subjects=subjects), fractions=("1",)))
    runs = {each: make_run(*methods, subjects=(each,), folder=tmp_path / each) for each in subjects}
    parts = []
    for subject, method in product(subjects, ("noting", "timed")):
        parts.append(str(tmp_path / f"{subject}-{method}"))
        curve_run(settings(runs[subject], out=parts[-1], fractions=("1",), methods=(method,)))
    joined = curve_runs(CurveReportSettings(tuple(parts), str(tmp_path / "joined")))
    shown = [
        [{k: v for k, v in p.items() if k not in MEASURED} for p in found.data["points"]]
        for found in (joined, whole)
    ]
    assert shown[0] == shown[1]
    assert {entry["metric"] for entry in joined.data["best"]} == {"psnr"}
    # The mean of a method on fewer subjects is not beside that of the others.
    fewer = curve_runs(CurveReportSettings(tuple(parts[:3]), str(tmp_path / "fewer")))
    assert len(fewer.data["points"]) == 3
    one = curve_runs(CurveReportSettings(tuple(parts[:2]), str(tmp_path / "one")))
    assert fewer.text.partition("Written:")[0] == one.text.partition("Written:")[0]

    def refused(said, *folders, over="budget"):
        with pytest.raises(InputError, match=said):
            curve_runs(CurveReportSettings(folders, str(tmp_path / "refused"), over))

    refused("a subject that all methods were trained on", parts[0], parts[3])
    refused("each training of noting on ball-a once", parts[0], parts[0])
    refused("run curve --over seconds`, found trainings of --over budget", *parts, over="seconds")
    other = str(tmp_path / "camera")
    curve_run(settings(runs["ball-a"], out=other, fractions=("1",), camera="4", methods=("timed",)))
    refused("the held-out frames of ball-a", parts[0], other)
    manifest = RunFolder(Path(parts[1])).read_manifest()
    seeds = replace(manifest.configuration, seeds=(1,))
    for changed, said in (
        ({"configuration": seeds}, r"seeds: expected .*1.*, found .*0"),
        ({"metrics": [replace(m, label="other") for m in manifest.metrics]}, "metrics: expected those of"),
        ({"methods": [replace(m, version="9") for m in manifest.methods]}, "version of timed: expected 9"),
    ):
        replace(manifest, **changed).write(RunFolder(Path(parts[1])).manifest)
        refused(said, parts[1], parts[3])
    assert not (tmp_path / "refused" / "curve.csv").exists()
