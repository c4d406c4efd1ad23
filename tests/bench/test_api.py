"""The functions of scripts give what the command line gives."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import headbench as hb

from ..world import SETTINGS, rows_of
from ..world import finished as finished_run

KEY = ["task", "timestep", "camera", "region", "metric"]


@pytest.fixture(scope="module")
def finished():
    """A run of ga and, among others, of insta, which is trained on another form of the capture."""
    return finished_run()


@pytest.fixture(scope="module")
def clip(finished):
    return hb.open_clip(finished.root.parent / "data")


@pytest.mark.parametrize("method", ["ga", "insta"])
def test_train_and_evaluate_give_the_rows_of_a_run(method, finished, clip, tmp_path):
    settings = SETTINGS.get(method, {})
    folder = hb.train(method, clip, tmp_path, preset="smoke", settings=settings)
    before = (folder / "avatar.json").stat().st_mtime_ns
    assert hb.train(method, clip, tmp_path, preset="smoke", settings=settings) == folder
    assert (folder / "avatar.json").stat().st_mtime_ns == before  # kept
    scores = hb.evaluate(folder, clip, metrics=["psnr"])
    rows = rows_of(finished)
    rows = rows[(rows.method == method) & (rows.metric == "psnr")]
    expected, found = (table.set_index(KEY).value.sort_index() for table in (rows, scores))
    pd.testing.assert_series_equal(found, expected, check_index_type=False, rtol=1e-6)


def test_an_avatar_in_memory_is_scored_alike(finished, clip):
    folder, how = finished.cell(clip.subject, "ga", 0).avatar, {"metrics": "psnr", "frames_per_task": 1}
    stored, loaded = (hb.evaluate(avatar, clip, **how) for avatar in (folder, hb.load_avatar(folder)))
    pd.testing.assert_frame_equal(stored, loaded)
    one = hb.evaluate(folder, finished.root.parent / "data", tasks="novel_view", regions="face", **how)
    pd.testing.assert_frame_equal(one, stored[stored.task == "novel_view"])


def test_the_table_of_runs_has_the_means_of_their_rows(finished):
    table = hb.read_runs(finished.root).table()
    rows = rows_of(finished)
    (held_out,) = set(rows[rows.task == "novel_view"].camera)
    names = rows.task.where(rows.task != "self_reenactment", "self_reenactment_seen")
    names[(rows.task == "self_reenactment") & (rows.camera == held_out)] = "self_reenactment_unseen"
    for task in ("novel_view", "self_reenactment_seen", "self_reenactment_unseen"):
        part = rows[(rows.method == "ga") & (names == task) & (rows.region == "full")]
        mean = part.groupby("sequence").value.mean().mean()
        assert table.loc["ga", (task, "psnr")] == pytest.approx(mean)


def test_a_head_is_posed_by_calling_it(clip, tmp_path):
    pose = next(iter(clip.poses.values()))
    moved = hb.HeadPose(**{**vars(pose), "translation": pose.translation + 1})
    hb.save_head(tmp_path / "head.npz", clip.head)
    still = clip.head(pose, clip.shape, clip.static_offset)
    again = hb.load_head(tmp_path / "head.npz")(moved, clip.shape, clip.static_offset)
    np.testing.assert_allclose(again - still, 1, atol=1e-5)


def test_what_scripts_get_wrong_is_refused(finished, clip, tmp_path):
    folder = finished.cell(clip.subject, "ga", 0).avatar
    cases = [
        (lambda: hb.open_clip(tmp_path), "a folder with a capture"),
        (lambda: hb.train("gaa", clip, tmp_path), "Did you mean 'ga'"),
        (lambda: hb.train("ga", clip, tmp_path, settings={"budget": {"iteratoins": 3}}), "iterations"),
        (lambda: hb.train("ga", clip, tmp_path, device="gpu"), "device"),
        (lambda: hb.train("insta", clip, tmp_path, device="cuda"), "device"),
        (lambda: hb.train("ga", clip, tmp_path, seed=-1), "seeds"),
        (lambda: hb.train("ga", clip, tmp_path, seed="x"), "seeds"),
        (lambda: hb.evaluate(folder, clip, tasks="novel_veiw"), "Did you mean 'novel_view'"),
        (lambda: hb.evaluate(folder, clip, metrics=["storage"]), "metrics of frames"),
        (lambda: hb.evaluate(folder, replace(clip, subject="x", shape=clip.shape + 1)), "avatar of x"),
        (lambda: hb.run(tmp_path, tmp_path / "out", sedes=(1,)), "seeds"),
    ]
    for call, said in cases:
        with pytest.raises(hb.InputError, match=said):
            call()
    assert not [*tmp_path.iterdir()]
