"""``headbench prepare refit`` on a capture on disk: what it writes reads back, and what it refuses."""

import json
import os
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.writer import capture_plan, write_capture
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.refit import refit as block
from headbench.datasets.head.refit.command import RefitCommandSettings, refit_capture, target_head

from ...tiny_capture import edit_json, make_plan, write_tiny_capture


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A capture, its head under another name as target, and what the command made of them."""
    root = tmp_path_factory.mktemp("refit")
    offset = np.zeros_like(make_plan().static_offset)
    tiny = write_tiny_capture(root / "capture", make_plan(static_offset=offset))
    save_head(root / "other.npz", replace(tiny.writer.plan.head, version="other"))
    settings = RefitCommandSettings(str(tiny.union), str(root / "other.npz"), str(root / "out"))
    return root, settings, refit_capture(settings)


def test_the_new_capture_has_the_same_frames(finished):
    _, settings, findings = finished
    old, new = read_capture(settings.capture), read_capture(findings.data["capture"])
    assert new.head.version == "other"
    for name, keys in old.splits.items():
        assert set(new.splits[name]) == set(keys)
    assert dict(new.excluded) == dict(old.excluded)
    for key, files in old.files.items():
        assert os.path.samefile(files.image, new.files[key].image)
        assert os.path.samefile(files.mask, new.files[key].mask)
    for name, camera in old.cameras.items():
        np.testing.assert_allclose(new.cameras[name].K, camera.K, atol=1e-6)
    for timestep, pose in old.poses.items():
        np.testing.assert_allclose(new.poses[timestep].jaw, pose.jaw, atol=0.01)


def test_report_and_picture(finished):
    root, _, findings = finished
    stored = json.loads((root / "out" / "refit.json").read_text())
    assert stored["timesteps"] == len(stored["frames"]) == 7
    assert stored["mean_mm"] == pytest.approx(np.mean([frame["mean_mm"] for frame in stored["frames"]]))
    assert stored["mean_mm"] < 0.15
    assert f"mean {stored['mean_mm']:.3f}" in findings.text
    assert sum(value is None for value in stored["vertices_mm"]) > 0
    picture = cv2.imread(str(root / "out" / "heat_map.png"))
    assert picture is not None
    assert picture.shape == (500, 880, 3)
    middle = picture[60:400, 320:560].reshape(-1, 3).astype(int)
    coloured = np.ptp(middle, axis=1) > 60
    assert coloured.mean() > 0.05  # the face; the rest of the head is grey


def test_started_again_it_fits_nothing_again(finished, monkeypatch):
    _, settings, findings = finished
    monkeypatch.setattr(block, "solve_frame", lambda *_: pytest.fail("fitted again"))
    assert refit_capture(settings).data == findings.data


def test_what_cannot_be_refitted_is_refused(finished):
    root, settings, findings = finished
    same = replace(settings, capture=findings.data["capture"], out=settings.out + "2")
    for changed, said in (
        (same, "another head model"),
        (replace(settings, out=str(root / "capture")), "outside the capture"),
        (replace(settings, target="no-such-head"), "no-such-head"),
        (replace(settings, target="any/procedural/head.npz"), "2020, 2023 or the file.*by their version"),
    ):
        with pytest.raises(InputError, match=said):
            refit_capture(changed)
    assert target_head("2020").version == target_head("procedural2020").version == "procedural2020"


def test_a_hole_in_the_grid_is_refused_before_the_fit(finished, tmp_path, monkeypatch):
    """A frame no JSON lists, its image still on disk: the layout written has no place to say so."""
    root, settings, _ = finished
    shutil.copytree(root / "capture", tmp_path / "capture")
    union = next((tmp_path / "capture").glob("UNION*"))
    edit_json(union / "transforms_train.json", lambda value: value["frames"].pop(1))
    (lost,) = {*read_capture(settings.capture).files} - {*read_capture(union).files}
    monkeypatch.setattr(block, "solve_frame", lambda *_: pytest.fail("fitted"))
    with pytest.raises(InputError) as caught:
        refit_capture(replace(settings, capture=str(union), out=str(tmp_path / "out")))
    assert (caught.value.file, caught.value.key) == (str(union), f"frame {lost}")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("other", [None, "another reason"])
def test_exclusions_of_part_of_a_timestep_are_refused(other, finished):
    """The layout excludes whole timesteps for one reason: one camera's exclusion would become all cameras'."""
    clip = read_capture(finished[1].capture)
    capture_plan(clip)
    key = sorted(clip.excluded)[1]
    excluded, splits = {**clip.excluded, key: other}, dict(clip.splits)
    if other is None:
        del excluded[key]
        splits["self_reenactment"] = (*splits["self_reenactment"], key)
    with pytest.raises(InputError, match=str(key)) as caught:
        capture_plan(replace(clip, excluded=excluded, splits=splits))
    assert caught.value.key == "excluded"


def test_splits_the_layout_cannot_hold_are_refused(finished):
    _, settings, _ = finished
    clip = read_capture(settings.capture)
    train = clip.splits["train"]
    # One training frame is called a novel view: its camera is then held out, and not all its frames are.
    swapped = {**clip.splits, "train": train[1:], "novel_view": (*clip.splits["novel_view"], train[0])}
    with pytest.raises(InputError, match="splits"):
        capture_plan(replace(clip, splits=swapped))


def test_a_sequence_whose_end_is_held_out_keeps_its_split(finished, tmp_path):
    """As VHAP exports a video: training and test frames of one sequence, no camera held out."""
    _, settings, _ = finished
    clip = read_capture(settings.capture)
    parts = {name: {*keys} for name, keys in clip.splits.items()}
    kept = parts["train"] | parts["novel_view"] | parts["self_reenactment"]
    sequence = min(key.sequence for key in parts["train"])
    last = max(key.timestep for key in kept if key.sequence == sequence)
    tested = {key for key in kept if key.sequence == sequence and key.timestep == last}
    splits = {"train": kept - tested, "novel_view": set(), "self_reenactment": tested}
    ordered = {name: tuple(sorted(keys)) for name, keys in splits.items()}
    written = read_capture(write_capture(replace(clip, splits=ordered), tmp_path))
    by_pose = {tuple(pose.jaw.tolist()): timestep for timestep, pose in clip.poses.items()}
    found = {
        name: {
            key._replace(timestep=by_pose[tuple(written.poses[key.timestep].jaw.tolist())]) for key in keys
        }
        for name, keys in written.splits.items()
    }
    assert found == splits
    alone = read_capture(next(tmp_path.glob(f"*_{sequence}_*")))
    assert {written.poses[key.timestep].jaw.tolist()[0] for key in alone.splits["self_reenactment"]}


def test_timesteps_with_gaps_are_numbered_anew(finished, tmp_path):
    _, settings, _ = finished
    clip = read_capture(settings.capture)
    gone = 1
    files = {key: value for key, value in clip.files.items() if key.timestep != gone}
    splits = {name: tuple(key for key in keys if key in files) for name, keys in clip.splits.items()}
    assert len(files) < len(clip.files)
    written = read_capture(write_capture(replace(clip, files=files, splits=splits), tmp_path))
    kept = sorted({key.timestep for key in files})
    assert sorted(written.poses) == [*range(len(kept))]
    for number, timestep in enumerate(kept):
        np.testing.assert_allclose(written.poses[number].jaw, clip.poses[timestep].jaw, atol=1e-6)
    for new, old in zip(sorted(written.files), sorted(files), strict=True):
        assert (new.sequence, new.camera) == (old.sequence, old.camera)
        np.testing.assert_array_equal(written.image(new), clip.image(old))
