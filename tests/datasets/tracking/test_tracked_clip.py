"""The condition ``tracked``: the change of the clip, that it is made once, and that it reaches the rows."""

import json
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from headbench.bench import cli
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.tracking.track import FOLDER, with_tracking


@pytest.fixture(scope="module")
def clip(patterned_capture):
    return read_capture(patterned_capture.union)


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
