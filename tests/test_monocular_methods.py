"""Videos of one camera from their folder to a table: methods train on them, and what cannot be measured is said."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.engine.captures import reader_of
from headbench.datasets.ga.reader import read_capture
from headbench.reports.table_report import table_text

from .datasets.head.toy import toy_head
from .datasets.monocular.videos import Recording, write_imavatar, write_insta
from .datasets.tiny_capture import FRONTAL, make_plan, rig, write_tiny_capture
from .world import rows_of, run_on


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    """One camera of a capture in both layouts."""
    folder = tmp_path_factory.mktemp("videos")
    head = toy_head(16, version="procedural2020")
    cameras = rig(24, 32, 12.3, 15.1)[:2]
    plan = make_plan(head=head, cameras=cameras, static_offset=np.zeros_like(head.template))
    clip = read_capture(write_tiny_capture(folder / "data", plan).union)
    still = {t: replace(pose, neck=np.zeros(3, np.float32)) for t, pose in clip.poses.items()}
    recording = Recording(replace(clip, poses=still), FRONTAL)
    write_insta(recording, folder / "insta", test=2, parameters=("exp",))
    write_imavatar(recording, folder / "imavatar")
    return folder


def compare(folder, out, *methods):
    return rows_of(run_on(folder, out, *methods, reader=reader_of(str(folder))))


@pytest.mark.parametrize("layout", ["insta", "imavatar"])
def test_tables_of_a_video_say_what_is_missing(videos, tmp_path, layout):
    rows = compare(videos / layout, tmp_path / "out", "mean-image", "nearest-camera")
    assert set(rows["task"]) == {"self_reenactment"}
    assert (rows["status"] == "ok").all()
    text = table_text([tmp_path / "out"])
    assert "Novel view is missing: the captures hold out no camera" in text
    assert text.count("Novel view") == 1


def test_a_method_trains_on_a_video(videos, tmp_path):
    rows = compare(videos / "insta", tmp_path / "out", "ga")
    assert (rows["status"] == "ok").all()
    assert rows["value"].between(1, 60).all()
