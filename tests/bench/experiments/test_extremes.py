"""``headbench run extremes`` on avatars whose behaviour at extremes is known beforehand."""

import json
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb
from scipy.stats import norm
from sklearn.decomposition import PCA

from headbench.bench.contracts import FrameKey, HeadPose
from headbench.bench.errors import InputError
from headbench.bench.experiments.extremes import (
    RECORD_FILE,
    ExtremesPlan,
    ExtremesSettings,
    PoseComponents,
    ReenactSettings,
    extremes_run,
    joint_samples,
    path_poses,
    reenact_run,
    sampled_poses,
)
from headbench.bench.experiments.specs import AGAINST_TRUTH
from headbench.bench.experiments.specs import MEASURES as STABILITY
from headbench.bench.io.images import read_png
from headbench.bench.io.lock import locked
from headbench.bench.registry import get
from headbench.reports.contact_sheet import BROKEN, EXTRAPOLATED, SHEET_FILE

CELLS = {
    f"{subject}/{method}/seed-0" for subject in ("ball-a", "ball-bee") for method in ("bursting", "listed")
}


def driven(command, folder, **changes):
    if command == "extremes":
        how = {"views": 2, "samples": 3, "path": 2}
        return extremes_run(ExtremesSettings(str(folder), trust=True, **how, **changes))
    return reenact_run(ReenactSettings(str(folder), trust=True, **changes))


@pytest.fixture(params=["extremes", "reenact"])
def command(request):
    return request.param


@pytest.fixture
def renders(balls, monkeypatch):
    """Counts the frames that are rendered."""
    done = []
    original = balls.Ball.render
    monkeypatch.setattr(balls.Ball, "render", lambda *given: done.append(1) or original(*given))
    return done


@pytest.mark.usefixtures("no_sheets")
@pytest.mark.commands
def test_worker_processes_leave_the_same(ball_run):
    folder = ball_run("BURSTING", "LISTED")
    outs = [folder.parent / name for name in ("inline", "tasks")]
    for out, how in zip(outs, ({}, {"executor": "processes", "workers": 1})):
        driven("extremes", folder, out=str(out), **how)
    left = [{p.relative_to(out).as_posix(): p for p in out.rglob("*") if p.is_file()} for out in outs]
    assert left[1].keys() - left[0].keys() == {f"{c}/job.log" for c in CELLS}
    for name, path in left[0].items():
        if not name.endswith(("run.json", "cell.json")):  # times
            assert path.read_bytes().replace(b"inline", b"tasks") == left[1][name].read_bytes(), name


@pytest.mark.usefixtures("no_sheets")
def test_what_is_done_is_kept(ball_run, command, renders):
    folder = ball_run("BALL")
    out = folder / "out"
    assert driven(command, folder, out=str(out)).passed
    before, whole = (out / "rows.parquet").read_bytes(), len(renders)
    assert driven(command, folder, out=str(out)).passed
    assert len(renders) == whole
    assert (out / "rows.parquet").read_bytes() == before


@pytest.mark.usefixtures("no_sheets")
def test_an_avatar_that_fails_is_recorded_and_the_others_go_on(ball_run, command, balls, monkeypatch):
    folder = ball_run("BALL", "SPLATTY")

    def burst(*given):
        raise RuntimeError("no splats today")

    monkeypatch.setattr(balls.Splatty, "splats", burst)
    found = driven(command, folder, out=str(folder / "out"))
    assert not found.passed
    assert "ball-a splatty seed 0 failed: RuntimeError: no splats today" in found.text
    rows = pd.read_parquet(folder / "out" / "rows.parquet")
    failed = rows[rows["method"] == "splatty"]
    assert set(failed["status"]) == {"failed"}
    assert set(failed["metric"]) == {metric.name for metric in get("conditions", command).metrics}
    record = json.loads((folder / "out" / "record.json").read_text())
    assert {avatar["method"] for avatar in record["avatars"]} == {"ball"}
    assert [each["subject"] for each in record["failed"]] == ["ball-a", "ball-bee"]


VIEWS, SAMPLES, PATH_FRAMES = 4, 2, 2
FRAMES = VIEWS + 2 * SAMPLES + PATH_FRAMES
MEASURES = 5 + 6 + 2  # of stability in every frame, and of appearance and surface against the truth


def settings(folder, **changes):
    how = {"views": VIEWS, "samples": SAMPLES, "path": PATH_FRAMES, **changes}
    return ExtremesSettings(str(folder), trust=True, **how)


def extreme_frames(balls, tmp_path):
    """Keys of the frames whose pose the plug-in takes for extreme, without the subject."""
    clip = balls.BallClip(tmp_path / "data" / "ball-a")
    plan = ExtremesPlan.of(clip, **settings("").parameters)
    frames = {
        (frame.name, frame.number, plan.views[frame.view].camera.id): balls.is_extreme(frame.pose)
        for frame in plan.frames
    }
    assert 0 < sum(frames.values()) < len(frames)
    return {key for key, extreme in frames.items() if extreme}


def shows(path, colour):
    return (read_png(path) == np.round(255 * np.array(to_rgb(colour)))).all(axis=2).any()


def test_a_stable_avatar_passes_and_what_has_no_truth_is_missing(ball_run):
    folder = ball_run("BALL", "FLOOR")
    found = extremes_run(settings(folder))
    assert found.passed
    rows = pd.read_parquet(folder / "extremes" / "rows.parquet")
    assert set(rows["method"]) == {"ball"}
    of_frames, of_avatars = rows[rows["task"] == "extremes"], rows[rows["task"] == ""]
    assert len(of_frames) == 2 * MEASURES * FRAMES  # subjects
    assert sorted(of_avatars["metric"]) == ["flicker"] * 2 + ["response"] * 2
    coverage = rows[rows["metric"] == "coverage"]
    assert coverage["status"].eq("ok").all()
    assert coverage["value"].between(0.9, 1.1).all()
    without = rows[rows["metric"].isin(["largest_splat", "mean_opacity"])]
    assert without["status"].eq("missing").all()
    assert without["reason"].str.contains("no splats").all()
    record = json.loads((folder / "extremes" / RECORD_FILE).read_text())
    views = record["avatars"][0]["views"]
    assert [v["azimuth"] for v in views] == pytest.approx(np.linspace(-90, 90, VIEWS), abs=0.01)
    assert [v["extrapolated"] for v in views] == [True, False, False, True]
    (protocol,) = record["protocols"]  # all subjects, methods of equal needs: one comparison
    assert set(of_frames["protocol"]) == {protocol["hash"]} == {a["protocol"] for a in record["avatars"]}
    assert protocol["id"] == "extremes/canonical/1"
    keys = of_frames[["subject", "sequence", "timestep", "camera"]].drop_duplicates()
    assert {tuple(key) for key in protocol["keys"]} == set(keys.itertuples(index=False, name=None))
    assert shows(folder / "extremes" / SHEET_FILE, EXTRAPOLATED)
    said = "not compared with the truth: Subject ball-a is recorded; only a synthetic capture has"
    assert said in found.text
    missing = rows[rows["metric"].isin([metric.name for metric in AGAINST_TRUTH])]
    assert set(missing["metric"]) == {metric.name for metric in AGAINST_TRUTH}
    assert set(missing["status"]) == {"missing"}
    assert missing["reason"].str.contains("headbench synth").all()
    assert not (folder / "extremes" / "truth").exists()


@pytest.mark.usefixtures("no_sheets")
def test_avatars_that_render_lists_alone_are_missing(ball_run):
    folder = ball_run("LISTED")
    found = extremes_run(settings(folder))
    assert found.passed
    assert "missing: Frames come in lists alone. Ask for a list." in found.text
    missing = pd.read_parquet(folder / "extremes" / "rows.parquet")
    assert set(missing["status"]) == {"missing"}
    assert missing["reason"].str.contains("in lists alone").all()
    assert set(missing["metric"]) == {metric.name for metric in (*STABILITY, *AGAINST_TRUTH)}


@pytest.mark.usefixtures("no_sheets")
def test_a_burst_where_jaw_and_expression_act_together_is_found(ball_run, balls, tmp_path):
    folder = ball_run("BURSTING", "BALL")
    found = extremes_run(settings(folder))
    assert not found.passed
    with pytest.raises(InputError, match="drive.parameters.beyond: .* choose another --out"):
        extremes_run(settings(folder, beyond=10.0))
    rows = pd.read_parquet(folder / "extremes" / "rows.parquet")
    failed = rows[rows["status"] == "failed"]
    frames = extreme_frames(balls, tmp_path)
    keys = failed[failed["subject"] == "ball-a"][["sequence", "timestep", "camera"]]
    assert set(keys.itertuples(index=False, name=None)) == frames
    assert set(failed["method"]) == {"bursting"}
    assert set(failed["metric"]) == {"coverage"}
    assert failed["value"].gt(2).all()  # the larger ball fills the frame
    assert failed["reason"].str.contains("limits 0.8 to 1.25").all()
    record = json.loads((folder / "extremes" / RECORD_FILE).read_text())
    by_method = {(a["subject"], a["method"]): a for a in record["avatars"]}
    assert by_method["ball-a", "bursting"]["frames_broken"] == len(frames)
    coverage = by_method["ball-a", "bursting"]["measures"]["coverage"]
    assert coverage["failed"] == len(frames)
    assert coverage["frames"] == FRAMES
    assert coverage["worst"] == failed[failed["subject"] == "ball-a"]["value"].max()
    assert by_method["ball-a", "ball"]["frames_broken"] == 0


def test_splats_that_grow_and_values_not_finite_are_found(ball_run, balls, tmp_path):
    folder = ball_run("SPLATTY", "BROKEN")
    found = extremes_run(settings(folder))
    assert not found.passed
    assert "non_finite is" in found.text
    out, extreme = folder / "extremes", len(extreme_frames(balls, tmp_path))
    rows = pd.read_parquet(out / "rows.parquet").query("status == 'failed' and method == 'splatty'")
    assert set(rows["metric"]) == {"largest_splat"}
    assert len(rows) == 2 * extreme
    # three deviations of 0.2 m, focal length 100 pixels, 1 m away, 30 pixels high
    assert np.allclose(rows["value"], 3 * 0.2 * 100 / 30, rtol=0.01)
    assert shows(out / SHEET_FILE, BROKEN)
    written = {path.name for path in (out / "ball-a" / "broken" / "seed-0").glob("*.png")}
    assert len(written) == FRAMES - extreme
    assert "typical_turntable-00.png" in written


@pytest.mark.usefixtures("no_sheets")
def test_what_is_not_there_is_refused_before_any_work(ball_run, run_of, tmp_path):
    folder, floor = ball_run("BALL", "FLOOR"), run_of("ball_plugin:FLOOR", folder=tmp_path / "floor")
    (tmp_path / "moved" / "ball-other").mkdir(parents=True)
    for run, changes, match in (
        (tmp_path / "typo", {}, r"run\.json"),
        (folder, {"methods": ("absent",)}, "methods"),
        (floor, {}, "no trivial baseline"),
        (folder, {"data": str(tmp_path / "moved")}, "the capture of the run"),
    ):
        with pytest.raises(InputError, match=match):
            extremes_run(settings(run, **changes))
    with locked(folder / "extremes"), pytest.raises(InputError, match="no other process"):
        extremes_run(settings(folder))
    record = folder / "ball-a" / "ball" / "seed-0" / "cell.json"
    record.write_text(record.read_text().replace('"trained"', '"training"'))
    with pytest.raises(InputError, match="training did not end"):
        extremes_run(settings(folder))
    record.unlink()
    with pytest.raises(InputError, match="a trained avatar"):
        extremes_run(settings(folder))
    assert not (folder / "extremes").exists()
    assert not (tmp_path / "typo").exists()
    with pytest.raises(ValueError, match="beyond"):
        ExtremesSettings("run", beyond=180.0)


@pytest.fixture
def values():
    """Expression (12) and jaw (3) of 40 timesteps, correlated."""
    rng = np.random.default_rng(3)
    return rng.normal(size=(40, 15)) @ rng.normal(size=(15, 15)) + rng.normal(size=15)


def poses_of(values):
    zero = np.zeros(3)
    return {
        t: HeadPose(
            "m", row[:-3].astype(np.float32), zero + t, zero, row[-3:], np.zeros(6), zero, None, "s", t
        )
        for t, row in enumerate(values)
    }


def clip_of(values):
    """A clip of a pose for each row, after which a held-out one follows that is far away."""
    keys = tuple(FrameKey("s", "EMO", t, c) for t in range(len(values)) for c in "ab")
    return SimpleNamespace(subject="s", poses=poses_of([*values, 100 + values[0]]), splits={"train": keys})


def joined(pose):
    return np.concatenate([pose.expression, pose.jaw])


def test_components_are_those_of_scikit_learn(values):
    """Of expression and jaw, each divided by the root of its total variance."""
    scale = np.repeat([np.sqrt(values[:, :12].var(0).sum()), np.sqrt(values[:, 12:].var(0).sum())], [12, 3])
    found, theirs = PoseComponents.of([*poses_of(values).values()], 5), PCA(5).fit(values / scale)
    assert np.allclose(found.mean / scale, theirs.mean_, atol=1e-6)
    ours = found.directions / scale
    assert np.allclose(np.linalg.norm(ours, axis=1) ** 2, theirs.explained_variance_, rtol=1e-5)
    cosines = (ours * theirs.components_).sum(axis=1) / np.linalg.norm(ours, axis=1)
    assert np.allclose(np.abs(cosines), 1.0, atol=1e-6)
    scores = theirs.transform(values / scale) / np.sqrt(theirs.explained_variance_) * np.sign(cosines)
    assert np.allclose(found.reach, [scores.min(axis=0), scores.max(axis=0)], atol=1e-4)


def test_directions_without_variation_are_left_out(values):
    flat = values.copy()
    flat[:, 3:] = 1.5
    assert len(PoseComponents.of([*poses_of(flat).values()], 8).directions) == 3
    still = clip_of(np.full((5, 15), 0.3))
    poses = sampled_poses(still, 8, 4, 3.0)
    assert len(poses) == 1
    assert path_poses(poses, 4) == []


def test_samples_vary_every_component_and_the_jaw_together(values):
    numbers = joint_samples(64, 8, 3.0)
    middles = norm.ppf((np.arange(64) + 0.5) / 64)
    assert np.allclose(np.sort(numbers, axis=0), middles[:, None])
    assert np.abs(np.corrcoef(numbers.T) - np.eye(8)).max() < 0.4
    assert np.array_equal(joint_samples(64, 8, 3.0), numbers)
    assert np.abs(joint_samples(64, 8, 0.5)).max() == 0.5
    clip = clip_of(values)
    base, *samples = sampled_poses(clip, 8, 16, 3.0)
    distances = np.linalg.norm(values[:, :12] - values[:, :12].mean(axis=0), axis=1)
    assert np.array_equal(base.expression, clip.poses[int(distances.argmin())].expression)
    assert all(pose.timestep is None and pose.expression.dtype == np.float32 for pose in samples)
    assert {pose.rotation.tobytes() for pose in samples} == {base.rotation.tobytes()}
    found = np.array([joined(pose) for pose in samples])
    assert (found.std(axis=0) > 0.3 * values.std(axis=0)).all()
    within = (found >= values.min(axis=0) - 1e-5) & (found <= values.max(axis=0) + 1e-5)
    assert within.all()


def test_a_path_is_smooth_and_passes_the_samples(values):
    poses = sampled_poses(clip_of(values), 8, 4, 3.0)
    path = np.array([joined(pose) for pose in path_poses(poses, 41)])
    for frame, pose in ((0, poses[0]), (20, poses[1]), (40, poses[2])):
        assert np.allclose(path[frame], joined(pose), atol=1e-5)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert steps[[0, 19, 20, 39]].max() < 0.2 * steps.max()
