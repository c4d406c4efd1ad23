"""``headbench run extremes`` on avatars whose behaviour at extremes is known beforehand."""

import json
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from sklearn.decomposition import PCA

from headbench.bench.contracts import FrameKey, HeadPose
from headbench.bench.errors import InputError
from headbench.bench.experiments import robustness
from headbench.bench.experiments.extremes import ExpressionComponents, extremes, typical_pose
from headbench.bench.experiments.robustness import RECORD_FILE, extremes_run
from headbench.bench.experiments.robustness_settings import ExtremesSettings
from headbench.bench.io.images import read_png
from headbench.bench.io.lock import LOCK_FILE, locked
from headbench.reports.robustness.sheets import BROKEN, EXTRAPOLATED, SHEET_FILE

VIEWS, COMPONENTS, STEPS = 6, 2, 6


def settings(folder, **changes):
    return ExtremesSettings(str(folder), trust=True, views=VIEWS, **changes)


def colours(path):
    return {to_hex(colour / 255) for colour in np.unique(read_png(path).reshape(-1, 3), axis=0)}


def test_a_stable_avatar_passes_and_every_pair_has_its_rows(ball_run):
    folder = ball_run("BALL", "FLOOR")
    found = extremes_run(settings(folder))
    assert found.passed
    rows = pd.read_parquet(folder / "extremes" / "rows.parquet")
    frames = VIEWS * (1 + COMPONENTS * STEPS)  # the third coefficient never varies: no third component
    assert set(rows["method"]) == {"ball"}
    assert set(rows["task"]) == {"extremes"}
    assert len(rows) == 2 * 5 * frames  # subjects, measures
    coverage = rows[rows["metric"] == "coverage"]
    assert coverage["status"].eq("ok").all()
    assert coverage["value"].between(0.9, 1.1).all()
    without = rows[rows["metric"].isin(["largest_splat", "mean_opacity"])]
    assert without["status"].eq("missing").all()
    assert without["reason"].str.contains("no splats").all()
    record = json.loads((folder / "extremes" / RECORD_FILE).read_text())
    views = record["avatars"][0]["views"]
    assert [v["azimuth"] for v in views] == pytest.approx(np.linspace(-90, 90, VIEWS), abs=0.01)
    assert [v["extrapolated"] for v in views] == [True, False, False, False, False, True]
    (protocol,) = record["protocols"]  # all subjects, methods of equal needs: one comparison
    assert set(rows["protocol"]) == {protocol["hash"]} == {a["protocol"] for a in record["avatars"]}
    assert protocol["id"] == "extremes/canonical/1"
    keys = rows[["subject", "sequence", "timestep", "camera"]].drop_duplicates()
    assert {tuple(key) for key in protocol["keys"]} == set(keys.itertuples(index=False, name=None))
    shown = colours(folder / "extremes" / SHEET_FILE)
    assert EXTRAPOLATED in shown


@pytest.mark.parametrize("others", [(), ("BALL",)])
def test_avatars_that_render_lists_alone_are_missing(ball_run, others):
    folder = ball_run("LISTED", *others)
    found = extremes_run(settings(folder))
    assert found.passed
    assert "missing: Frames come in lists alone. Ask for a list." in found.text
    rows = pd.read_parquet(folder / "extremes" / "rows.parquet")
    missing = rows[rows["method"] == "listed"]
    assert set(missing["status"]) == {"missing"}
    assert missing["reason"].str.contains("in lists alone").all()
    assert len(missing) == 2 * 5 * VIEWS * (1 + COMPONENTS * STEPS)
    assert (folder / "extremes" / SHEET_FILE).exists() == bool(others)


def test_rows_that_are_there_are_kept(ball_run):
    folder = ball_run("BALL", "BURSTING")
    extremes_run(settings(folder, methods=("ball", "bursting")))
    before = (folder / "extremes" / "rows.parquet").read_bytes()
    with pytest.raises(InputError, match="hoose another --out"):  # other views: another protocol
        extremes_run(settings(folder, beyond=10.0))
    assert (folder / "extremes" / "rows.parquet").read_bytes() == before
    assert {a["method"] for a in extremes_run(settings(folder, methods=("ball",))).data["avatars"]} == {
        "ball",
        "bursting",
    }
    assert (folder / "extremes" / "rows.parquet").read_bytes() == before


def test_a_burst_is_found_where_it_is_and_nowhere_else(ball_run):
    folder = ball_run("BURSTING", "BALL")
    found = extremes_run(settings(folder))
    assert not found.passed
    rows = pd.read_parquet(folder / "extremes" / "rows.parquet")
    failed = rows[rows["status"] == "failed"]
    # The first coefficient has a deviation of 0.82 about 0: two and three of them are beyond 1.5.
    assert set(failed["sequence"]) == {"pc1-3", "pc1-2", "pc1+2", "pc1+3"}
    assert set(failed["method"]) == {"bursting"}
    assert set(failed["metric"]) == {"coverage"}
    assert len(failed) == 2 * 4 * VIEWS
    assert failed["value"].gt(2).all()  # the larger ball fills the frame
    assert failed["reason"].str.contains("limits 0.8 to 1.25").all()
    record = json.loads((folder / "extremes" / RECORD_FILE).read_text())
    by_method = {(a["subject"], a["method"]): a["frames_broken"] for a in record["avatars"]}
    assert by_method["ball-a", "bursting"] == 4 * VIEWS
    assert by_method["ball-a", "ball"] == 0


def test_values_that_are_no_numbers_break_a_limit(ball_run):
    folder = ball_run("BROKEN")
    found = extremes_run(settings(folder))
    assert not found.passed
    assert "non_finite is" in found.text
    first = folder / "extremes" / "ball-a" / "broken" / "seed-0"
    assert not (first / "pc1+3_turntable-00.png").exists()
    assert (first / "pc1+1_turntable-00.png").exists()


def test_a_splat_that_grows_is_found_in_the_splats_alone(ball_run):
    folder = ball_run("SPLATTY")
    rows = extremes_run(settings(folder)) and pd.read_parquet(folder / "extremes" / "rows.parquet")
    failed = rows[rows["status"] == "failed"]
    assert set(failed["metric"]) == {"largest_splat"}
    assert set(failed["sequence"]) == {"pc1-3", "pc1-2", "pc1+2", "pc1+3"}
    # three deviations of 0.2 m, focal length 100 pixels, 1 m away, 30 pixels high
    assert np.allclose(failed["value"], 3 * 0.2 * 100 / 30, rtol=0.01)
    assert BROKEN in colours(folder / "extremes" / SHEET_FILE)


def test_what_is_not_there_is_refused_before_any_work(ball_run, tmp_path):
    folder = ball_run("BALL", "FLOOR")
    with pytest.raises(InputError, match=r"run\.json"):
        extremes_run(settings(tmp_path))
    with pytest.raises(InputError, match="methods"):
        extremes_run(settings(folder, methods=("absent",)))
    (tmp_path / "moved" / "ball-other").mkdir(parents=True)
    with pytest.raises(InputError, match="the capture of the run"):
        extremes_run(settings(folder, data=str(tmp_path / "moved")))
    fit = folder / "ball-a" / "ball" / "seed-0" / "fit.json"
    fit.write_text(fit.read_text().replace('"done"', '"started"'))
    with pytest.raises(InputError, match="training did not end"):
        extremes_run(settings(folder))
    fit.unlink()
    with pytest.raises(InputError, match="a trained avatar"):
        extremes_run(settings(folder))
    assert not (folder / "extremes").exists()
    with pytest.raises(InputError, match=r"run\.json"):
        extremes_run(settings(tmp_path / "typo"))
    assert not (tmp_path / "typo").exists()


def test_a_run_of_trivial_baselines_has_nothing_to_test(ball_run):
    folder = ball_run("FLOOR")
    with pytest.raises(InputError, match="no trivial baseline"):
        extremes_run(settings(folder))
    assert extremes_run(settings(folder, methods=("floor",))).passed


@pytest.mark.parametrize("changes", [{"views": 0}, {"beyond": 180.0}, {"sigmas": (0.0, 1.0)}, {"sigmas": ()}])
def test_settings_without_meaning_are_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        ExtremesSettings("run", **changes)


def test_clips_are_adapted_in_its_folder_while_that_is_locked(ball_run, monkeypatch):
    seen = []

    def trained(run, methods, options, out):
        seen.append((out, (out / LOCK_FILE).exists()))
        raise InputError("a", "b", "c", "d")

    monkeypatch.setattr(robustness, "trained", trained)
    folder = ball_run("BALL")
    with pytest.raises(InputError):
        extremes_run(settings(folder))
    assert seen == [(folder / "extremes", True)]
    assert not (folder / "extremes").exists()


def test_its_folder_is_locked_and_no_link_out_of_the_run(ball_run, tmp_path):
    folder = ball_run("BALL")
    with locked(folder / "extremes"), pytest.raises(InputError, match="no other process"):
        extremes_run(settings(folder))
    outside = tmp_path / "outside"
    outside.mkdir()
    (folder / "extremes").symlink_to(outside)
    with pytest.raises(InputError, match="a link to"):
        extremes_run(settings(folder))
    assert list(outside.iterdir()) == []


@pytest.fixture
def coefficients():
    rng = np.random.default_rng(3)
    return rng.normal(size=(40, 12)) @ rng.normal(size=(12, 12)) + rng.normal(size=12)


def clip_of(coefficients, held_out=None):
    zero = np.zeros(3)
    rows = coefficients if held_out is None else np.vstack([coefficients, held_out])
    poses = {
        t: HeadPose(
            "m", row.astype(np.float32), zero + t, zero, zero + 2 * t, np.zeros(6), zero, None, "s", t
        )
        for t, row in enumerate(rows)
    }
    keys = tuple(FrameKey("s", "EMO", t, c) for t in range(len(coefficients)) for c in "ab")
    return SimpleNamespace(subject="s", poses=poses, splits={"train": keys})


def test_components_are_those_of_scikit_learn(coefficients):
    ours, theirs = ExpressionComponents.of(coefficients, 5), PCA(5).fit(coefficients)
    assert np.allclose(ours.mean, theirs.mean_)
    assert np.allclose(ours.deviations**2, theirs.explained_variance_)
    assert np.allclose(np.abs((ours.directions * theirs.components_).sum(axis=1)), 1.0)
    step = ours.at(2, -3.0) - theirs.mean_
    assert np.allclose(theirs.transform([ours.at(2, -3.0)])[0][[0, 1, 3, 4]], 0, atol=1e-9)
    assert np.isclose(np.linalg.norm(step), 3 * np.sqrt(theirs.explained_variance_[2]))


def test_directions_without_variation_are_left_out(coefficients):
    flat = coefficients.copy()
    flat[:, 3:] = 1.5
    assert len(ExpressionComponents.of(flat, 8).deviations) == 3
    assert len(ExpressionComponents.of(np.full((5, 4), 0.3), 8).deviations) == 0


def test_every_step_along_every_component_after_the_mean(coefficients):
    found = extremes(clip_of(coefficients), 2, (-3.0, 1.0))
    assert [e.name for e in found] == ["mean", "pc1-3", "pc1+1", "pc2-3", "pc2+1"]
    assert np.allclose(found[0].pose.expression, coefficients.mean(axis=0), atol=1e-5)
    assert all(e.pose.timestep is None and e.pose.expression.dtype == np.float32 for e in found)
    assert len({e.pose.rotation.tobytes() for e in found}) == 1


def test_held_out_expressions_have_no_say(coefficients):
    with_others = clip_of(coefficients, held_out=100 * np.ones((9, 12)))
    for a, b in zip(extremes(clip_of(coefficients), 8, (3.0,)), extremes(with_others, 8, (3.0,))):
        assert np.array_equal(a.pose.expression, b.pose.expression)


def test_the_typical_pose_is_a_real_one(coefficients):
    poses = list(clip_of(coefficients).poses.values())
    distances = np.linalg.norm(coefficients - coefficients.mean(axis=0), axis=1)
    assert typical_pose(poses) is poses[int(distances.argmin())]
