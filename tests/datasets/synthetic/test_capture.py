import json
import os

import cv2
import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga_reader import read_capture
from headbench.datasets.synthetic.capture import synthesize
from headbench.datasets.synthetic.rig import FRONTAL

SMALL = {"cameras": 2, "timesteps": 8, "size": (32, 46), "samples_per_pixel": 9, "workers": 1}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    out = tmp_path_factory.mktemp("synthetic") / "capture"
    calls = []
    (union,) = synthesize(out, **SMALL, progress=lambda done, total, note="": calls.append((done, total)))
    return out, union, calls


def images(out):
    return {path.relative_to(out): path.read_bytes() for path in sorted(out.rglob("*.png"))}


def test_reader_reads_what_was_planned(capture):
    _, union, calls = capture
    clip = read_capture(union)
    assert calls[0] == (0, 16)
    assert calls[-1] == (16, 16)
    assert {key.camera for key in clip.splits["train"]} == set(clip.cameras) - {FRONTAL}
    assert {key.camera for key in clip.splits["novel_view"]} == {FRONTAL}
    assert {key.sequence for key in clip.splits["self_reenactment"]} == {"FREE"}
    assert {key.sequence for key in clip.splits["train"]}.isdisjoint({"FREE"})
    assert clip.excluded
    assert all("tongue" in reason for reason in clip.excluded.values())
    key = clip.splits["train"][0]
    assert clip.image(key).shape == (46, 32, 3)
    assert len({tuple(pose.expression) for pose in clip.poses.values()}) == 8


def test_killed_run_continues_to_the_same_images(capture):
    out, union, _ = capture
    before = images(out)
    chosen = sorted(before)[::5]
    (out / chosen[0]).unlink()
    (out / chosen[1]).write_bytes(before[chosen[1]][:100])  # as a kill without renaming would leave it
    untouched = {path: os.stat(out / path).st_mtime_ns for path in before if path.name != chosen[0].name}
    (union / "transforms_train.json").unlink()
    synthesize(out, **SMALL)
    assert images(out) == before
    assert (union / "transforms_train.json").exists()
    same = [path for path in untouched if path.name != chosen[1].name]
    assert all(os.stat(out / path).st_mtime_ns == untouched[path] for path in same)


def test_other_settings_are_refused(capture):
    with pytest.raises(InputError, match="seed"):
        synthesize(capture[0], **SMALL, seed=5)
    with pytest.raises(InputError, match="performance"):
        synthesize(capture[0], **SMALL, performance="still")


def test_a_folder_of_part_of_the_performance_is_not_continued_with_all_of_it(capture, tmp_path):
    settings = json.loads((capture[0] / "synthesis.json").read_text())
    assert "performance" not in settings  # as captures were recorded before there was a choice
    (tmp_path / "synthesis.json").write_text(json.dumps({**settings, "performance": "still"}))
    with pytest.raises(InputError, match="performance"):
        synthesize(tmp_path, **SMALL)


def test_foreign_folder_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("irreplaceable")
    with pytest.raises(InputError, match="other files"):
        synthesize(tmp_path, **SMALL)


@pytest.mark.parametrize(
    "change",
    [
        {"cameras": 1},
        {"cameras": 17},
        {"timesteps": 2},
        {"size": (8, 8)},
        {"tracking_noise": -0.1},
        {"subjects": 0},
        {"performance": "asleep"},
        {"dynamics": -0.5},
        {"dynamics": float("nan")},
    ],
)
def test_bad_settings_are_refused_before_anything_is_written(tmp_path, change):
    out = tmp_path / "capture"
    with pytest.raises(InputError):
        synthesize(out, **{**SMALL, **change})
    assert not out.exists()


def test_unknown_head_is_refused(tmp_path):
    with pytest.raises(InputError, match="--head"):
        synthesize(tmp_path / "capture", **SMALL, head="no-such-file.npz")


def test_capture_says_that_it_is_synthetic(capture):
    out, union, _ = capture
    assert "synthetic" in (out / "README.txt").read_text()
    assert json.loads((union / "headbench.json").read_text())["synthetic"]["seed"] == 0
    picture = cv2.imread(str(next(out.rglob("images/*.png"))))
    assert np.ptp(picture) > 100
