"""Reading what the writer wrote and what the field's tools write."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.contracts import Clip, FrameKey
from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import find_captures, read_capture
from headbench.datasets.ga.tracking import pose_to_parameters
from headbench.datasets.ga.writer import CaptureWriter, identity_parameters
from headbench.datasets.head.arrays import with_derived_regions
from headbench.datasets.head.teeth import with_teeth
from headbench.datasets.images import write_image

from ..head.toy import toy_head
from ..tiny_capture import (
    FRONTAL,
    SERIALS,
    edit_npz,
    make_plan,
    rig,
    write_tiny_capture,
)

# Union timesteps follow the plan's training sequences, then FREE.
ORDER = [("EMO-1-shout+laugh", 2), ("SEN-01-cramp_small_danger", 2), ("FREE", 3)]
PLACES = [(name, local) for name, count in ORDER for local in range(count)]


@pytest.fixture(scope="module")
def clip(pristine_capture):
    return read_capture(pristine_capture.union)


def test_cameras_survive_the_round_trip(clip, pristine_capture):
    assert [*clip.cameras] == [*SERIALS]
    for camera in pristine_capture.writer.plan.cameras:
        read = clip.cameras[camera.id]
        np.testing.assert_allclose(read.K, camera.K, rtol=0, atol=1e-12)
        np.testing.assert_allclose(read.world_to_camera, camera.world_to_camera, rtol=0, atol=1e-12)
        assert (read.width, read.height) == (camera.width, camera.height)


def test_poses_identity_and_offset_survive_exactly(clip, pristine_capture):
    plan = pristine_capture.writer.plan
    assert isinstance(clip, Clip)
    for timestep, (sequence, local) in enumerate(PLACES):
        written, read = plan.sequence(sequence).poses[local], clip.poses[timestep]
        for field in ("expression", "rotation", "neck", "jaw", "eyes", "translation"):
            np.testing.assert_array_equal(getattr(read, field), getattr(written, field))
        assert (read.head_model, read.subject, read.timestep) == (plan.head.version, "901", timestep)
    np.testing.assert_array_equal(clip.shape, plan.shape)
    np.testing.assert_array_equal(clip.static_offset, plan.static_offset)
    assert clip.head.fingerprint() == with_derived_regions(plan.head).fingerprint()


def test_images_and_masks_survive_exactly(clip, pristine_capture):
    for key in clip.files:
        sequence, local = PLACES[key.timestep]
        assert key.sequence == sequence
        image, mask = pristine_capture.frames[sequence, local, key.camera]
        np.testing.assert_array_equal(clip.image(key), image)
        np.testing.assert_array_equal(clip.mask(key), mask)


def test_splits_hold_out_the_frontal_camera_and_free(clip):
    others = [name for name in SERIALS if name != FRONTAL]

    def keys(timesteps, cameras):
        return {FrameKey("901", PLACES[t][0], t, c) for t in timesteps for c in cameras}

    assert set(clip.splits["train"]) == keys(range(4), others)
    assert set(clip.splits["novel_view"]) == keys(range(4), [FRONTAL])
    assert set(clip.splits["self_reenactment"]) == keys((4, 5), SERIALS)
    assert clip.excluded == dict.fromkeys(keys([6], SERIALS), "tongue out")


def test_eyelids_survive_or_are_said_to_be_left_out(tmp_path, caplog):
    head = toy_head(16, eyelids=True)
    plan = make_plan(head=head, lengths={"FREE": 1, "HAIR": 1})
    union = write_tiny_capture(tmp_path, plan).union
    np.testing.assert_array_equal(
        read_capture(union).poses[0].eyelids, plan.sequence("HAIR").poses[0].eyelids
    )
    clip = read_capture(union, head=replace(head, eyelid_basis=None))
    assert "left out: the head model has no basis" in clip.steps[0].parameters["eyelids"]
    assert "Put l_eyelid.npy and r_eyelid.npy" in caplog.text


def test_a_single_sequence_is_read_with_its_declared_head(pristine_capture):
    clip = read_capture(pristine_capture.writer.sequence_folder("SEN-01-cramp_small_danger"))
    assert clip.subject == "901"
    assert {key.sequence for key in clip.files} == {"SEN-01-cramp_small_danger"}
    assert clip.timesteps("train") == [0, 1]
    assert {key.camera for key in clip.splits["novel_view"]} == {FRONTAL}
    tongue = read_capture(pristine_capture.writer.sequence_folder("FREE"))
    assert {key.timestep for key in tongue.excluded} == {2}


def test_one_camera_has_no_novel_view(tmp_path):
    plan = make_plan(cameras=rig()[:1], novel_view_cameras=())
    clip = read_capture(write_tiny_capture(tmp_path, plan).union)
    assert [len(clip.splits[name]) for name in ("train", "novel_view", "self_reenactment")] == [4, 0, 2]


def test_captures_are_found_from_the_folder_above(pristine_capture, tmp_path):
    root = pristine_capture.writer.root
    assert find_captures(root) == [pristine_capture.union]
    assert read_capture(root).fingerprint == read_capture(pristine_capture.union).fingerprint
    with pytest.raises(InputError, match="an empty folder"):
        read_capture(tmp_path)


def write_ga_style(root: Path, plan, *, shifts=(0.0, 0.0), offset_rows: int | None = None) -> Path:
    """A union as GaussianAvatars reads it: ``camera_angle_x`` alone, no extension, no serials, RGB only.

    Two sequences of two timesteps; each world is shifted along x as VHAP does per sequence.
    """
    names = ["074_EMO-1_v16_DS4_whiteBg", "074_EXP-2_v16_DS4_whiteBg"]
    splits: dict[str, list] = {"train": [], "val": [], "test": []}
    for number, (name, shift) in enumerate(zip(names, shifts)):
        for local, pose in enumerate(plan.sequences[number].poses[:2]):
            (root / name / "flame_param").mkdir(parents=True, exist_ok=True)
            moved = replace(pose, translation=pose.translation + np.float32([shift, 0, 0]))
            identity = identity_parameters(plan.shape, plan.static_offset[:offset_rows])
            np.savez(root / name / f"flame_param/{local:05d}.npz", **pose_to_parameters(moved), **identity)
            for index, camera in enumerate(plan.cameras):
                image = np.full((camera.height, camera.width, 3), 40 * number + 10 * local + index, np.uint8)
                write_image(root / name / "images" / f"{local:05d}_{index:02d}.png", image)
                matrix = np.linalg.inv(camera.world_to_camera) @ np.diag([1, -1, -1, 1])
                matrix[0, 3] += shift
                frame = {
                    "timestep_index": 2 * number + local,
                    "camera_index": index,
                    "camera_angle_x": 2 * math.atan(camera.width / (2 * camera.K[0, 0])),
                    "transform_matrix": matrix.tolist(),
                    "file_path": f"../{name}/images/{local:05d}_{index:02d}",
                    "flame_param_path": f"../{name}/flame_param/{local:05d}.npz",
                }
                splits["test" if number else "val" if index == 1 else "train"].append(frame)
    union = root / "UNION10_074_EMO1234EXP234589_v16_DS2-0.5x_lmkSTAR_teethV3_SMOOTH_offsetS_whiteBg"
    union.mkdir()
    for part, frames in splits.items():
        (union / f"transforms_{part}.json").write_text(json.dumps({"frames": frames}))
    return union


def test_ga_style_json_with_camera_angle_alone(tmp_path):
    plan = make_plan()
    clip = read_capture(write_ga_style(tmp_path, plan), head=plan.head)
    assert clip.subject == "074"
    assert {key.sequence for key in clip.files} == {"EMO-1", "EXP-2"}
    assert [*clip.cameras] == ["00", "01", "02"]
    focal = plan.cameras[0].K[0, 0]
    expected = [[focal, 0, 24], [0, focal, 32], [0, 0, 1]]
    np.testing.assert_allclose(clip.cameras["00"].K, expected, rtol=1e-12)
    assert [len(clip.splits[name]) for name in ("train", "novel_view", "self_reenactment")] == [4, 2, 6]
    assert clip.mask(clip.splits["train"][0]) is None
    np.testing.assert_array_equal(clip.background, [1, 1, 1])


def test_shifted_sequence_worlds_are_brought_together(tmp_path):
    plan = make_plan()
    union = write_ga_style(tmp_path, plan, shifts=(0.01, -0.03))
    clip = read_capture(union, head=plan.head)
    # The second sequence moves by +0.04 m into the first's world, cameras and poses alike.
    record = clip.steps[0].parameters["sequence_shifts_m"]
    np.testing.assert_allclose(record["EXP-2"], [0.04, 0, 0], atol=1e-12)
    first, second = (plan.sequences[number].poses[0] for number in (0, 1))
    np.testing.assert_allclose(clip.poses[0].translation, first.translation + [0.01, 0, 0], atol=1e-7)
    np.testing.assert_allclose(clip.poses[2].translation, second.translation + [0.01, 0, 0], atol=1e-7)
    for name, camera in zip(("00", "01", "02"), plan.cameras):
        np.testing.assert_allclose(clip.cameras[name].center, camera.center + [0.01, 0, 0], atol=1e-12)


@pytest.mark.parametrize("rows_in_file", ["with teeth", "without teeth"])
def test_teeth_are_appended_and_the_offset_padded(tmp_path, rows_in_file):
    bare = toy_head(16)
    toothed = with_teeth(bare)
    plan = make_plan(head=toothed)
    rows = None if rows_in_file == "with teeth" else len(bare.template)
    union = write_ga_style(tmp_path, plan, offset_rows=rows)
    clip = read_capture(union, head=bare, teeth="auto" if rows is None else "add")
    assert clip.head.fingerprint() == toothed.fingerprint()
    np.testing.assert_array_equal(
        clip.static_offset[: len(bare.template)], plan.static_offset[: len(bare.template)]
    )
    expected = plan.static_offset[len(bare.template) :] if rows is None else 0
    np.testing.assert_array_equal(clip.static_offset[len(bare.template) :] - expected, 0)
    with pytest.raises(InputError, match="static_offset: expected .1, .* rows"):
        read_capture(write_ga_style(tmp_path / "other", plan, offset_rows=len(bare.template) - 7), head=bare)


@pytest.mark.parametrize("written", ["top", "bottom"])
def test_undeclared_cy_is_told_from_the_images(tmp_path, written):
    plan = make_plan(cy=written, cameras=rig(72, 96, cy=44.0), lengths={"FREE": 2, "EMO-1-shout+laugh": 4})
    capture = write_tiny_capture(tmp_path, plan)
    (capture.union / "headbench.json").unlink()
    clip = read_capture(capture.union)
    assert clip.steps[0].parameters["cy"] == written
    assert clip.cameras[FRONTAL].K[1, 2] == pytest.approx(44.0)
    # The wrong reading would have been off by 8 px.
    assert clip.steps[0].parameters["cy_from"]["source"] == "outlines"
    capture.without_masks()
    assert read_capture(capture.union).steps[0].parameters["cy"] == written


def test_undecidable_cy_asks_for_a_declaration(capture):
    (capture.union / "headbench.json").unlink()
    for path in capture.writer.root.rglob("fg_masks/*.png"):
        write_image(path, np.full((64, 48), 255, np.uint8))
    with pytest.raises(InputError, match='State the convention: cy="bottom"'):
        read_capture(capture.union)
    assert read_capture(capture.union, cy="bottom").cameras[FRONTAL].K[1, 2] == pytest.approx(29.3)
    assert read_capture(capture.union, cy="top").cameras[FRONTAL].K[1, 2] == pytest.approx(64 - 29.3)
    np.testing.assert_array_equal(
        read_capture(capture.union, cy="centre").cameras[FRONTAL].K[:2, 2], [24, 32]
    )


def test_splits_can_be_made_anew(capture):
    clip = read_capture(capture.union, held_out_sequences=["SEN-01"], held_out_cameras=[SERIALS[0]])
    assert {key.sequence for key in clip.splits["self_reenactment"]} == {"SEN-01-cramp_small_danger"}
    assert {key.sequence for key in clip.splits["train"]} == {"EMO-1-shout+laugh", "FREE"}
    assert {key.camera for key in clip.splits["novel_view"]} == {SERIALS[0]}
    assert FRONTAL in {key.camera for key in clip.splits["train"]}
    with pytest.raises(InputError, match="held_out_sequences: expected one sequence"):
        read_capture(capture.union, held_out_sequences=["HAIR"])
    with pytest.raises(InputError, match="held_out_cameras"):
        read_capture(capture.union, held_out_cameras=["7"])


def test_missing_and_other_head_models_are_refused(capture):
    with pytest.raises(InputError, match="head_model"):
        read_capture(capture.union, head=toy_head(16, version="other"))
    (capture.union / "head_model.npz").unlink()
    with pytest.raises(InputError, match=r"head_model.npz"):
        read_capture(capture.union)


def test_rgba_is_composited_on_the_background_asked_for(tmp_path):
    plan = make_plan(lengths={"FREE": 1, "HAIR": 1})
    writer = CaptureWriter(tmp_path, plan)
    rng = np.random.default_rng(0)
    frames = {}
    for sequence in plan.sequences:
        for camera in plan.cameras:
            rgba = rng.integers(0, 256, size=(camera.height, camera.width, 4)).astype(np.uint8)
            frames[sequence.name, camera.id] = rgba
            writer.write_frame(sequence.name, 0, camera.id, rgba)
    clip = read_capture(writer.write_metadata(), background=(0.0, 0.5, 1.0))
    for key in clip.files:
        rgba = frames[key.sequence, key.camera].astype(np.float64)
        alpha = rgba[..., 3:] / 255
        expected = rgba[..., :3] * alpha + np.array([0, 127.5, 255]) * (1 - alpha)
        assert np.abs(clip.image(key) - expected).max() <= 0.5 + 1e-4
        np.testing.assert_array_equal(clip.mask(key), rgba[..., 3])


def test_rgb_images_change_their_background_by_their_masks(capture):
    clip = read_capture(capture.union, background=(0, 0, 1))
    np.testing.assert_array_equal(clip.background, [0, 0, 1])
    assert [step.name for step in clip.steps][1] == "set_background"
    plain = read_capture(capture.union)
    for key in list(clip.files)[:4]:
        inside = clip.mask(key) == 255
        np.testing.assert_array_equal(clip.image(key)[inside], plain.image(key)[inside])
        assert (clip.image(key)[~inside] == [0, 0, 255]).all()
    capture.without_masks()
    with pytest.raises(InputError, match="background: expected .*neither mask nor alpha"):
        read_capture(capture.union, background=(0, 0, 0))


def test_fingerprint_follows_content_and_not_place(capture, pristine_capture):
    original = read_capture(pristine_capture.union)
    assert read_capture(capture.union).fingerprint == original.fingerprint
    assert read_capture(capture.union, cy="centre").fingerprint != original.fingerprint
    assert read_capture(capture.union, exclude={0: "blur"}).fingerprint != original.fingerprint
    below = read_capture(capture.union, below_neck=False)
    assert ("mask_below_neck", True) == (below.steps[1].name, below.fingerprint != original.fingerprint)
    path = capture.writer.image_path("FREE", 0, FRONTAL)
    write_image(path, 255 - np.asarray(original.image(FrameKey("901", "FREE", 4, FRONTAL))))
    assert read_capture(capture.union).fingerprint != original.fingerprint
    path = next(capture.writer.sequence_folder("FREE").glob("flame_param/*.npz"))
    before = read_capture(capture.union).fingerprint
    edit_npz(path, lambda arrays: arrays["jaw_pose"].__iadd__(np.float32(0.01)))
    assert read_capture(capture.union).fingerprint != before
