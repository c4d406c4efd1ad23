"""Forms that methods declare, from a capture on disk to rows: what must not change does not."""

import dataclasses
import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from headbench.bench.engine.captures import reader_of
from headbench.bench.specs import ResolutionRule
from headbench.datasets.ga.reader import read_capture
from headbench.methods.trivial.spec import MEAN_IMAGE
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


SQUARE = ResolutionRule(square="pad", size=(128, 128))
FORMS = {
    "VIDEO": {"name": "video", "monocular": True},
    "SQUARE": {"name": "square", "resolution": SQUARE},
    "BOTH": {"name": "both", "monocular": True, "resolution": SQUARE},
}


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """Rows of a comparison of the mean image with itself in other forms."""
    folder = tmp_path_factory.mktemp("forms")
    capture = write_tiny_capture(folder / "data")
    module = ModuleType("forms_of_the_mean")
    for name, form in FORMS.items():
        setattr(module, name, dataclasses.replace(MEAN_IMAGE, **form))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, module.__name__, module)
        forms = (f"{module.__name__}:{name}" for name in FORMS)
        run = run_on(capture.union, folder / "out", "mean-image", *forms)
    return rows_of(run)


def values(rows, method):
    chosen = rows[rows["method"] == method].sort_values(["task", "sequence", "timestep", "camera"])
    assert (chosen["status"] == "ok").all()
    return chosen.reset_index(drop=True)


def test_the_mean_of_a_video_is_the_mean_of_its_views(rows):
    """To the bit but for the order of summation, and under the keys of the protocol."""
    plain, video = values(rows, "mean-image"), values(rows, "video")
    keys = ["task", "sequence", "timestep", "camera", "protocol"]
    assert video[keys].equals(plain[keys])
    assert video["value"].to_numpy() == pytest.approx(plain["value"].to_numpy(), abs=1e-3)


@pytest.mark.parametrize("name", ["square", "both"])
def test_a_detour_over_another_size_costs_little(rows, name):
    plain, detour = values(rows, "mean-image"), values(rows, name)
    assert detour["protocol"].equals(plain["protocol"])
    assert abs(detour["value"] - plain["value"]).max() < 0.5  # dB: softened, not shifted
