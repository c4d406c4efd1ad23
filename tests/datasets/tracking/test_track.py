"""The tracker on pictures of a known mesh: how near it comes, and what it refuses."""

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.tracking import track as track_module
from headbench.datasets.tracking.equations import SPEED
from headbench.datasets.tracking.fit import Fitter, sampled_vertices
from headbench.datasets.tracking.landmarks import known_rig_landmarks, spread_vertices
from headbench.datasets.tracking.rig import FrameStack, PoseColumns, Views, outliers
from headbench.datasets.tracking.track import (
    FOLDER,
    error_regions,
    mesh_errors,
    track,
    tracking_errors,
    with_tracking,
)

from ..head.toy import toy_head


def ramp(width, height, along, across):
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.repeat((10 + along * x + across * y)[..., None], 3, axis=2).astype(np.uint8)


def test_values_and_gradients_of_ramps():
    stack = FrameStack([ramp(20, 30, 2, 4), ramp(40, 20, 4, 2)])
    stack.filter(0.0)
    frames, places = np.array([0, 1, 1]), np.array([[7.25, 11.5], [30.0, 9.75], [3.5, 4.5]])
    values, gradients = stack.sample(frames, places)
    slopes = np.array([[2, 4], [4, 2], [4, 2]])
    wanted = 10 + (slopes * places).sum(axis=1)
    np.testing.assert_allclose(values, np.repeat(wanted[:, None], 3, axis=1) / 255, atol=5e-3)
    np.testing.assert_allclose(gradients, np.repeat(slopes[:, None], 3, axis=1) / 255, atol=2e-3)


@pytest.fixture(scope="module")
def clip(patterned_capture):
    return read_capture(patterned_capture.union)


@pytest.fixture(scope="module")
def tracked(clip):
    """The clip as the tracker sees it with all cameras."""
    return track(clip, [*clip.cameras], source(clip, [*clip.cameras]))


def source(clip, cameras, seed=0):
    return partial(known_rig_landmarks, clip, cameras, seed=seed)


def skin_errors(tracked, exact):
    """Errors of the face, lips and lids included."""
    front = np.asarray(exact.head.regions["face"])
    poses = sorted(exact.poses)
    found, wanted = (PosedSubject.of(one).meshes([one.poses[t] for t in poses]) for one in (tracked, exact))
    turns = PosedSubject.of(exact).motions([exact.poses[t] for t in poses])[:, :3, :3]
    return mesh_errors(found[:, front], wanted[:, front], turns)


def by_landmarks(clip, cameras):
    """The clip as landmarks alone track it."""
    timesteps = sorted(clip.poses)
    fitter = Fitter(
        clip.head,
        Views([clip.cameras[name] for name in cameras]),
        source(clip, cameras)(timesteps),
        sampled_vertices(clip.head),
    )
    state = fitter.fit_landmarks(fitter.start())
    poses = PoseColumns.of(clip.head).poses(state.poses, clip.head, clip.subject, timesteps)
    zeros = np.zeros_like(clip.static_offset)
    return replace(clip, shape=state.shape, static_offset=zeros, poses=dict(zip(timesteps, poses)))


def test_colours_correct_landmarks(clip, tracked):
    before, after = skin_errors(by_landmarks(clip, [*clip.cameras]), clip), skin_errors(tracked.clip, clip)
    assert after.motion < 0.5 * before.motion
    assert after.absolute < before.absolute
    assert 0 < np.abs(tracked.clip.static_offset).max() < 0.04
    assert [residual.timestep for residual in tracked.report.residuals] == sorted(clip.poses)
    assert tracked.clip.steps[-1].name == "track"


@pytest.fixture(scope="module")
def frontal(clip):
    """The frontal camera, and the clip as the tracker sees it with that alone."""
    name = next(name for name in clip.cameras if name.endswith("37"))
    return name, track(clip, [name], source(clip, [name])).clip


def test_the_clips_own_tracking_is_not_used(clip, frontal):
    camera, tracked = frontal
    landmarks = source(clip, [camera])(sorted(clip.poses))
    wrong = {t: replace(p, jaw=np.ones(3), translation=np.full(3, 9.0)) for t, p in clip.poses.items()}
    other = replace(clip, poses=wrong, shape=clip.shape + 5, static_offset=clip.static_offset + 1)
    found = track(other, [camera], lambda timesteps: landmarks).clip
    np.testing.assert_array_equal(found.shape, tracked.shape)
    for timestep, pose in found.poses.items():
        np.testing.assert_array_equal(pose.jaw, tracked.poses[timestep].jaw)


def test_one_camera_is_enough(clip, frontal):
    camera, single = frontal
    views = Views([clip.cameras[camera]])
    timesteps, face = sorted(clip.poses), np.asarray(clip.head.regions["face"])

    def places(one):
        meshes = PosedSubject.of(one).meshes([one.poses[timestep] for timestep in timesteps])
        return np.array([views.place(mesh[face])[0][0] for mesh in meshes])

    gaps = [places(one) - places(clip) for one in (single, by_landmarks(clip, [camera]))]
    after, before = (np.linalg.norm(gap - gap.mean(axis=0), axis=2).mean() for gap in gaps)
    assert after < 0.7 * before


def test_blocks_share_the_shape(clip, frontal, monkeypatch):
    monkeypatch.setattr("headbench.datasets.tracking.track.MOST_TIMESTEPS", 3)
    asked = []

    def noted(timesteps):
        asked.append([*timesteps])
        return source(clip, frontal[:1])(timesteps)

    tracked, report = track(clip, frontal[:1], noted)
    assert [len(part) for part in asked] == [3, 2]
    assert sorted(asked[0] + asked[1]) == sorted(tracked.poses) == [one.timestep for one in report.residuals]


def test_parts_of_the_last_pass_are_linked_by_time(clip, frontal, monkeypatch):
    timesteps, fit_block, passes = sorted(clip.poses), track_module._fit_block, []
    camera = clip.cameras[frontal[0]]
    monkeypatch.setattr(track_module, "MOST_PIXELS", 12 * camera.width * camera.height)  # three timesteps

    def noted(*given):
        fitted, last = fit_block(*given), given[8]
        if last is not None:
            passes.append((given[3], last.motion, fitted["poses"]))
        return fitted

    monkeypatch.setattr(track_module, "_fit_block", noted)
    times = dict(zip(timesteps, [0.0, 0.04, 5.0, 5.04, 5.12]))
    track(clip, frontal[:1], source(clip, frontal[:1]), times=times)
    assert [part for part, _, _ in passes] == [timesteps[:3], timesteps[3:]]
    (_, first, poses), (_, second, _) = passes
    np.testing.assert_array_equal(second.before, poses[-1])
    speeds = [one.deviations[:, 0] / SPEED[0][0] for one in (first, second)]
    np.testing.assert_allclose(np.concatenate(speeds), [np.inf, 0.04, 4.96, 0.04, 0.08])


def test_what_cannot_be_tracked_is_left_out(clip, frontal):
    timesteps = sorted(clip.poses)

    def lost(part):
        landmarks = source(clip, frontal[:1])(part)
        landmarks.pixels[part.index(timesteps[1])] = np.nan
        return landmarks

    tracked, report = track(clip, frontal[:1], lost)
    assert report.left_out == [*report.without_landmarks] == [timesteps[1]]
    assert (
        sorted(tracked.poses) == [one.timestep for one in report.residuals] == [timesteps[0], *timesteps[2:]]
    )
    assert timesteps[1] not in {key.timestep for key in [*tracked.files, *sum(tracked.splits.values(), ())]}
    assert report.summary()["left_out"] == 1 == tracked.steps[-1].parameters["residual"]["left_out"]


def test_a_wrong_fit_is_repeated_from_a_neighbour(clip, frontal, monkeypatch):
    """In place of the first fit, one that puts the head elsewhere at two timesteps; at one of them it does so again."""
    timesteps, (kept, lost) = sorted(clip.poses), (1, 3)
    whole, fit_block = {}, track_module._fit_block

    def moved(*given):
        fitted, part = fit_block(*given), given[3]
        wrong = [lost] if whole else [kept, lost]
        for row, timestep in enumerate(part):
            if timestep in [timesteps[one] for one in wrong]:
                fitted["poses"][row, PoseColumns.of(clip.head).translation] += 0.5
            whole.setdefault(timestep, fitted["poses"][row])
        return fitted

    monkeypatch.setattr(track_module, "_fit_block", moved)
    tracked, report = track(clip, frontal[:1], source(clip, frontal[:1]))
    assert (report.fitted_again, report.outliers) == ((timesteps[kept],), (timesteps[lost],))
    gap = tracked.poses[timesteps[kept]].translation - frontal[1].poses[timesteps[kept]].translation
    assert np.abs(gap).max() < 0.02


def test_outliers_are_jumps_and_failed_fits():
    columns = PoseColumns(0, 0)
    time = np.arange(40)
    poses, residuals = np.zeros((40, columns.size)), np.full((40, 2), 2.0)
    poses[:, 1] = np.pi + 0.7 * np.sin(time / 4)  # 100 degrees a second at 25 frames, through half a turn
    poses[20:, columns.translation] += 1.0  # another recording
    assert not outliers(poses, residuals, columns).any()
    poses[5:8, 4] += 0.5  # the neck
    poses[12, columns.translation] += 0.2
    residuals[30] = 2.0, 6.0
    residuals[35:38] = 0.0, 1.0
    assert np.flatnonzero(outliers(poses, residuals, columns)).tolist() == [5, 6, 7, 12, 30, 35, 36, 37]
    failed = outliers(poses, residuals, columns, jumps=False)
    assert np.flatnonzero(failed).tolist() == [30, 35, 36, 37]
    assert not outliers(poses[::8], residuals[:5], columns).any()  # so few that motion looks like jumps


def test_what_is_missing_is_refused(clip):
    cameras = [*clip.cameras]

    def nothing(timesteps):
        landmarks = source(clip, cameras)(timesteps)
        return landmarks._replace(pixels=np.full_like(landmarks.pixels, np.nan))

    key = min(clip.files)
    without = replace(clip, files={one: file for one, file in clip.files.items() if one != key})
    for given, found in (
        ((clip, [], source(clip, cameras)), "cameras.*none"),
        ((clip, ["nowhere"], source(clip, cameras)), "cameras.*nowhere"),
        ((clip, cameras, nothing), "landmarks"),
        ((without, cameras, source(clip, cameras)), f"timestep {key.timestep} of camera {key.camera}"),
    ):
        with pytest.raises(InputError, match=found):
            track(*given)


def test_spread_points_are_far_apart():
    points = np.random.default_rng(0).random((300, 3))
    chosen = points[spread_vertices(points, 20)]
    gaps = np.linalg.norm(chosen[:, None] - chosen, axis=2) + np.eye(20)
    random = np.linalg.norm(points[:20, None] - points[:20], axis=2) + np.eye(20)
    assert gaps.min() > 2 * random.min()


@pytest.mark.commands
def test_the_clip_has_other_tracking_and_the_same_frames(clip, tmp_path, monkeypatch):
    config = SimpleNamespace(out=str(tmp_path))
    one = with_tracking(clip, config, seed=1)
    monkeypatch.setattr("headbench.datasets.tracking.track.track", None)  # the parameters are kept
    two = with_tracking(clip, config, seed=1)
    assert one.splits == clip.splits
    assert one.fingerprint == two.fingerprint != clip.fingerprint
    assert len([*(tmp_path / FOLDER).glob("*.npz")]) == 1
    for timestep, pose in one.poses.items():
        np.testing.assert_array_equal(pose.expression, two.poses[timestep].expression)
        gap = np.abs(pose.translation - clip.poses[timestep].translation).max()
        assert 1e-5 < gap < 0.05


def test_scored_frames_that_cannot_be_tracked_have_a_pose(clip, tmp_path, monkeypatch):
    def without_first(capture, cameras, source, **how):
        return SimpleNamespace(
            clip=replace(capture, poses={t: p for t, p in capture.poses.items() if t != first})
        )

    first, second, *_ = sorted(clip.poses)
    monkeypatch.setattr(track_module, "track", without_first)
    changed = with_tracking(clip, SimpleNamespace(out=str(tmp_path)))
    assert {*changed.splits["train"]} == {key for key in clip.splits["train"] if key.timestep != first}
    assert all(changed.splits[task] == clip.splits[task] for task in ("novel_view", "self_reenactment"))
    assert changed.poses[first].timestep == first
    assert changed.poses[first].jaw.tolist() == changed.poses[second].jaw.tolist()


@pytest.mark.commands
def test_the_change_reaches_the_rows(patterned_capture, tmp_path):
    conditions = json.dumps([{}, {"name": "tracked", "clip": {"name": "tracked", "parameters": {"seed": 2}}}])
    words = f"run --data {patterned_capture.union} --methods ga --preset smoke --out {tmp_path / 'r'}".split()
    for setting in ("settings.ga.budget.iterations=2", "metrics=psnr", f"conditions={conditions}"):
        words += ["--set", setting]
    assert cli.main(words) == 0
    rows = pd.read_parquet(tmp_path / "r" / "rows.parquet")
    means = rows[rows["metric"] == "psnr"].groupby("condition")["value"].mean()
    assert set(means.index) == {"", "tracked"}
    assert means["tracked"] != means[""]


def test_a_shift_is_absolute_and_a_shift_that_changes_is_motion():
    wanted = np.random.default_rng(0).standard_normal((4, 20, 3))
    motions = np.tile(np.eye(3), (4, 1, 1))
    found = mesh_errors(wanted + [0, 0.003, 0.004], wanted, motions)
    assert found == pytest.approx((5, 0, 0), abs=1e-9)
    moved = wanted[:2] + np.array([[[0.001, 0, 0]], [[-0.001, 0, 0]]])
    assert mesh_errors(moved, wanted[:2], motions[:2]).motion == pytest.approx(1)


def test_regions_do_not_overlap():
    regions = error_regions(toy_head(24))
    inner = [regions[name] for name in ("face", "lips", "lids", "eyeballs") if name in regions]
    together = np.concatenate(inner)
    assert len(together) == len(np.unique(together))
    assert {"face", "lips", "eyeballs"} <= set(regions)


def test_a_translated_clip(pristine_capture):
    exact = read_capture(pristine_capture.union)
    poses = {
        t: replace(p, translation=np.asarray(p.translation) + [0, 0, 0.002]) for t, p in exact.poses.items()
    }
    errors = tracking_errors(replace(exact, poses=poses), exact)
    for error in errors.values():
        assert error.absolute == pytest.approx(2, abs=1e-3)
        assert error.affine == pytest.approx(0, abs=1e-3)


def test_another_topology_is_refused(pristine_capture):
    clip = read_capture(pristine_capture.union)
    with pytest.raises(InputError, match="topology"):
        tracking_errors(replace(clip, head=toy_head(24)), clip)
