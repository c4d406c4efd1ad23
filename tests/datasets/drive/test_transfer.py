"""Lines that arrive one by one give the poses of the same lines in a file."""

import json
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.drive.formats import read_signal
from headbench.datasets.drive.signal import SignalRequest
from headbench.datasets.drive.transfer import LiveDriver, transfer
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.teeth import with_teeth

from ..head.toy import toy_head

SOURCE = toy_head(24, eyelids=True, version="flame2020")
TARGET = with_teeth(replace(SOURCE, version="target"))


@pytest.mark.parametrize("target", [SOURCE, TARGET], ids=["same head", "another with teeth"])
def test_lines_give_the_poses_of_a_file(tmp_path, target):
    rng = np.random.default_rng(0)
    frames = [{"exp": rng.normal(size=8).tolist(), "pose": [0, 0.1 * t, 0, 0.1 * t, 0, 0]} for t in range(4)]
    path = tmp_path / "a.jsonl"
    path.write_text("\n".join(map(json.dumps, frames)))
    save_head(tmp_path / "head.npz", SOURCE)
    head = str(tmp_path / "head.npz") if target is TARGET else ""
    signal = read_signal(SignalRequest(path, target, signal_head=head))
    wanted = transfer(signal, target, None)
    assert wanted.residual_mm is None or wanted.residual_mm < 0.02
    driver = LiveDriver(target, head)
    for frame, pose in zip(frames, wanted.poses):
        found = driver(json.dumps(frame))
        np.testing.assert_allclose(found.expression, pose.expression, atol=5e-3)
        np.testing.assert_allclose(found.jaw, pose.jaw, atol=2e-3)
        np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-6)


@pytest.mark.parametrize("line", ["{}", "[1]", "x", '{"what": 1}', '{"jawOpen": "wide"}'])
def test_lines_of_no_frame_are_refused(line):
    with pytest.raises(InputError, match="live signal"):
        LiveDriver(SOURCE)(line)
