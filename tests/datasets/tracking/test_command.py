"""``headbench track`` on a capture on disk: what it writes reads back, and what it refuses."""

import json
import os

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.io.files import TEMPORARY, write_text
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.images import read_image
from headbench.datasets.tracking.command import _moved, track_capture
from headbench.datasets.tracking.settings import WORK, TrackSettings, make_work_folder


@pytest.fixture(scope="module")
def finished(patterned_capture, tmp_path_factory):
    out = tmp_path_factory.mktemp("tracked") / "out"
    capture = str(patterned_capture.union)
    return out, track_capture(TrackSettings(capture, str(out), against=capture))


@pytest.mark.commands
def test_the_tracked_capture_reads_back(finished, patterned_capture):
    old, new = read_capture(patterned_capture.union), read_capture(finished[1].data["capture"])
    assert {name: set(keys) for name, keys in new.splits.items()} == {
        n: set(k) for n, k in old.splits.items()
    }
    assert all(os.path.samefile(file.image, new.files[key].image) for key, file in old.files.items())
    assert 0 < np.abs(new.static_offset).max() < 0.04
    assert any(abs(new.poses[t].translation - old.poses[t].translation).max() > 1e-5 for t in old.poses)


@pytest.mark.commands
def test_report_and_picture(finished):
    out, result = finished
    stored = json.loads((out / "track.json").read_text())
    assert stored["timesteps"] == len(stored["residuals"]) == 5
    assert f"{stored['errors_mm']['face']['absolute']:.2f}" in result.text
    height, width, _ = read_image(out / "overlay.png", (1, 1, 1)).shape
    assert (height, width) == (3 * 160, 2 * 3 * 120)


@pytest.mark.commands
def test_a_folder_tracked_by_other_settings_is_left_alone(finished, patterned_capture):
    out, _ = finished
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    with pytest.raises(InputError, match="settings.seed: expected 1, found 0"):
        track_capture(TrackSettings(str(patterned_capture.union), str(out), seed=1))
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before


def test_a_whole_capture_takes_the_place_of_an_earlier_one(tmp_path):
    out, staged = tmp_path / "out", tmp_path / "staged"
    for home, names in ((out, ("0", "1")), (staged, ("0",))):
        for name in names:
            write_text(home / "901_FREE" / "images" / f"{name}.png", home.name)
        write_text(home / "UNION1_901" / "transforms_train.json", home.name)
    assert _moved(staged / "UNION1_901", out) == out / "UNION1_901"
    found = {str(path.relative_to(out)): path.read_text() for path in out.rglob("*") if path.is_file()}
    assert found == {"901_FREE/images/0.png": "staged", "UNION1_901/transforms_train.json": "staged"}


@pytest.mark.parametrize("kind", ["a link", "a file", "files of something else"])
def test_what_it_did_not_make_is_never_deleted(patterned_capture, tmp_path, kind):
    out, other = tmp_path / "out", tmp_path / "other"
    for folder in (out, other):
        folder.mkdir()
    (other / "mine.txt").write_text("mine")
    place = out / WORK
    match kind:
        case "a link":
            place.symlink_to(other)
        case "a file":
            place.write_text("mine")
        case _:
            other.rename(place)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=f"that headbench track made, or none, found {kind}"):
        track_capture(TrackSettings(str(patterned_capture.union), str(out)))
    assert sorted(tmp_path.rglob("*")) == before


def test_a_folder_that_a_kill_left_empty_is_used(tmp_path):
    (tmp_path / WORK).mkdir()
    (tmp_path / WORK / f"{TEMPORARY}1.txt").touch()
    for _ in range(2):
        make_work_folder(tmp_path / WORK)
    assert (tmp_path / WORK / "README.txt").is_file()


def test_what_does_not_fit_is_refused(patterned_capture, tmp_path):
    capture, out = str(patterned_capture.union), str(tmp_path / "out")
    headless = patterned_capture.copied(tmp_path / "capture").union
    (headless / "head_model.npz").unlink()
    missing = str(tmp_path / "network.tflite")
    for given, found in (
        (TrackSettings(capture, out, embedding=capture), "landmarks"),
        (TrackSettings(capture, out, landmarks=missing, embedding=capture), "no such file"),
        (TrackSettings(str(headless), out), "head model"),
        (TrackSettings(capture, out, focal=900.0), "--focal: expected a video file"),
        (TrackSettings(capture, out, held_out_frames=3), "--held-out-frames: expected a video file"),
        (TrackSettings(capture, str(patterned_capture.writer.root)), "outside the capture"),
    ):
        with pytest.raises(InputError, match=found):
            track_capture(given)
