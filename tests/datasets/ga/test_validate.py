"""Every fault of a capture is found when it is opened, and named."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.validate import find_leaks
from headbench.datasets.images import write_image

from ..tiny_capture import FRONTAL, SERIALS

TRAIN = "transforms_train.json"


def fault(capture, **settings) -> InputError:
    """The error that opening the capture raises; always one paragraph."""
    with pytest.raises(InputError) as caught:
        read_capture(capture.union, **settings)
    assert "\n" not in str(caught.value)
    return caught.value


# ------------------------------------------------------------------ images


def test_missing_image(capture):
    path = capture.writer.image_path("EMO-1-shout+laugh", 1, SERIALS[2])
    path.unlink()
    error = fault(capture)
    assert error.file.endswith(TRAIN)
    assert error.key == "frames[3].file_path"
    assert path.name in error.found


def test_missing_mask(capture):
    capture.writer.mask_path("FREE", 0, FRONTAL).unlink()
    error = fault(capture)
    assert (error.file[-20:], error.key) == ("transforms_test.json", "frames[1].fg_mask_path")


def test_empty_image(capture):
    path = capture.writer.image_path("FREE", 1, FRONTAL)
    path.write_bytes(b"")
    error = fault(capture)
    assert error.file.endswith(f"images/{path.name}")
    assert error.found == "an empty file"


@pytest.mark.parametrize("lost", [1, 12, 500])
def test_truncated_image(capture, lost):
    path = capture.writer.image_path("SEN-01-cramp_small_danger", 0, FRONTAL)
    path.write_bytes(path.read_bytes()[:-lost])
    error = fault(capture)
    assert error.file.endswith(f"images/{path.name}")
    assert error.found == "a truncated file"


def test_damage_in_the_middle_is_found_by_decoding(capture):
    path = capture.writer.image_path("FREE", 0, FRONTAL)
    data = bytearray(path.read_bytes())
    data[60:90] = bytes(30)
    path.write_bytes(bytes(data))
    error = fault(capture, decode=True)
    assert error.file.endswith(path.name)
    assert error.found == "damaged data"


def test_image_that_is_none(capture):
    capture.writer.image_path("FREE", 0, FRONTAL).write_text("<html>not found</html>")
    assert "PNG or JPEG" in fault(capture).expected


def test_image_of_another_size_than_declared(capture):
    write_image(capture.writer.image_path("FREE", 0, FRONTAL), np.zeros((32, 24, 3), np.uint8))
    error = fault(capture)
    assert "48x64 pixels" in error.expected
    assert error.found == "24x32"


def test_mask_of_another_size_than_its_image(capture):
    write_image(capture.writer.mask_path("FREE", 0, FRONTAL), np.zeros((32, 24), np.uint8))
    assert fault(capture).file.endswith("fg_masks/00000_01.png")


def test_sixteen_bit_image(capture):
    path = capture.writer.image_path("FREE", 0, FRONTAL)
    cv2.imwrite(str(path), np.zeros((64, 48, 3), np.uint16))
    assert fault(capture).expected == "8 bits per channel"


# ------------------------------------------------------------------ JSONs


FRAME_FAULTS = {
    "missing timestep": ("timestep_index", None),
    "fractional timestep": ("timestep_index", 1.5),
    "textual timestep": ("timestep_index", "1"),
    "negative camera": ("camera_index", -1),
    "numeric serial": ("camera_id", 222200037),
    "missing image": ("file_path", None),
    "missing parameters": ("flame_param_path", None),
    "missing matrix": ("transform_matrix", None),
    "short matrix": ("transform_matrix", [[1, 0], [0, 1]]),
    "ragged matrix": ("transform_matrix", [[1, 0, 0, 0], [0, 1]]),
    "matrix of texts": ("transform_matrix", [["a"] * 4] * 4),
    "scaled rotation": ("transform_matrix", np.diag([2.0, 2, 2, 1]).tolist()),
    "mirror": ("transform_matrix", np.diag([1.0, -1, 1, 1]).tolist()),
    "matrix with NaN": ("transform_matrix", np.diag([1.0, np.nan, 1, 1]).tolist()),
    "zero focal length": ("fl_x", 0),
    "angle in degrees": ("camera_angle_x", 30.0),
    "textual centre": ("cx", "24"),
    "infinite centre": ("cy", float("inf")),
    "boolean width": ("w", True),
}


@pytest.mark.parametrize(("key", "value"), FRAME_FAULTS.values(), ids=FRAME_FAULTS.keys())
def test_bad_entry_of_a_frame(capture, key, value):
    def change(document):
        if value is None:
            del document["frames"][5][key]
        else:
            document["frames"][5][key] = value

    capture.edit(TRAIN, change)
    error = fault(capture)
    assert error.file.endswith(TRAIN)
    assert error.key.startswith(f"frames[5].{key}")
    if value is None:
        assert error.found == "no such key"


def test_frame_without_any_focal_length(capture):
    def change(document):
        for level in (document, document["frames"][0]):
            del level["fl_x"], level["camera_angle_x"]

    capture.edit(TRAIN, change)
    error = fault(capture)
    assert (error.key, error.expected) == ("frames[0]", "fl_x or camera_angle_x")


def test_missing_json(capture):
    (capture.union / "transforms_val.json").unlink()
    error = fault(capture)
    assert error.file.endswith("transforms_val.json")
    assert error.found == "no such file"


@pytest.mark.parametrize("text", ["", "{", '{"frames": [', "[1, 2]", '{"frames": {}}', '{"frames": [3]}'])
def test_json_that_is_none(capture, text):
    (capture.union / TRAIN).write_text(text)
    assert fault(capture).file.endswith(TRAIN)


def test_gap_in_timesteps(capture):
    def drop(document):
        document["frames"] = [frame for frame in document["frames"] if frame["timestep_index"] != 1]

    for part in ("train", "val"):
        capture.edit(f"transforms_{part}.json", drop)
    error = fault(capture)
    assert error.key == "timestep_index"
    assert "no frame of timestep 1" in error.found


def test_timestep_with_two_parameter_files(capture):
    def change(document):
        frame = document["frames"][1]
        frame["flame_param_path"] = frame["flame_param_path"].replace("00000.npz", "00001.npz")

    capture.edit(TRAIN, change)
    assert fault(capture).key == "frames[1].flame_param_path"


def test_frame_listed_twice(capture):
    capture.edit(TRAIN, lambda document: document["frames"].append(document["frames"][0]))
    assert "2 times" in fault(capture).found


# ------------------------------------------------------------------ cameras


def test_camera_that_moves(capture):
    def change(document):
        document["frames"][2]["transform_matrix"][0][3] += 0.001

    capture.edit(TRAIN, change)
    error = fault(capture)
    assert error.key == "frames[2].transform_matrix"


def test_sequences_whose_cameras_differ_by_more_than_a_shift(capture):
    def change(document):
        for frame in document["frames"]:
            if "FREE" in frame["file_path"] and frame["camera_index"] == 2:
                frame["transform_matrix"][1][3] += 0.01

    capture.edit("transforms_test.json", change)
    assert "but for one shift" in fault(capture).expected


def test_focal_length_that_contradicts_the_angle(capture):
    def change(document):
        for frame in document["frames"]:
            frame["fl_x"] *= 2

    for part in ("train", "val", "test"):
        capture.edit(f"transforms_{part}.json", change)
    assert "not scaled with the images" in fault(capture).remedy


def test_serial_that_changes_its_index(capture):
    def change(document):
        document["frames"][3]["camera_id"] = SERIALS[0]

    capture.edit(TRAIN, change)
    assert fault(capture).key == "frames[3].camera_id"


def test_intrinsics_that_change(capture):
    def change(document):
        document["frames"][3]["cx"] += 1

    capture.edit(TRAIN, change)
    assert "intrinsics of camera" in fault(capture).expected


# ------------------------------------------------------------------ parameters


PARAMETER_FAULTS = {
    "missing array": ("jaw_pose", None),
    "wrong shape": ("eyes_pose", np.zeros((1, 3), np.float32)),
    "NaN": ("expr", np.full((1, 8), np.nan, np.float32)),
    "infinite offset": ("static_offset", np.full((1, 278, 3), np.inf, np.float32)),
    "too many coefficients": ("shape", np.zeros(300, np.float32)),
    "texts": ("rotation", np.array([["a", "b", "c"]])),
    "flat offset": ("static_offset", np.zeros(278 * 3, np.float32)),
}


@pytest.mark.parametrize(("key", "value"), PARAMETER_FAULTS.values(), ids=PARAMETER_FAULTS.keys())
def test_bad_parameter_array(capture, key, value):
    path = capture.writer.sequence_folder("FREE") / "flame_param" / "00001.npz"
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    arrays.pop(key)
    np.savez(path, **arrays | ({} if value is None else {key: value}))
    error = fault(capture)
    assert (error.file[-17:], error.key) == ("e_param/00001.npz", key)


def test_parameter_file_that_is_missing_or_damaged(capture):
    path = capture.writer.sequence_folder("FREE") / "flame_param" / "00001.npz"
    path.write_bytes(path.read_bytes()[:200])
    assert fault(capture).file == str(
        capture.union / "../901_FREE_v3_whiteBg_staticOffset/flame_param/00001.npz"
    )
    path.unlink()
    assert fault(capture).file.endswith("00001.npz")


def test_parameter_file_with_a_pickle_is_not_unpickled(capture, tmp_path):
    path = capture.writer.sequence_folder("FREE") / "flame_param" / "00001.npz"

    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "touched"), "w"))

    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    np.savez(path, **arrays | {"expr": np.array([[Bomb()]], dtype=object)})
    assert fault(capture).file.endswith("00001.npz")
    assert not (tmp_path / "touched").exists()


# ------------------------------------------------------------------ our declaration


DECLARATION_FAULTS = {
    "format_version": 99,
    "subject": 3,
    "background": [1, 2, 3],
    "cy": "middle",
    "sequences": {"a": 1},
    "excluded": [{"timestep": "1", "reason": "tongue"}],
    "synthetic": [],
    "head_file": None,
}


@pytest.mark.parametrize(("key", "value"), DECLARATION_FAULTS.items(), ids=DECLARATION_FAULTS.keys())
def test_bad_declaration(capture, key, value):
    capture.edit("headbench.json", lambda document: document.update({key: value}))
    error = fault(capture)
    assert error.file == str(capture.union / "headbench.json")
    assert error.key.startswith(key)


def test_declaration_without_an_entry(capture):
    capture.edit("headbench.json", lambda document: document.pop("cy"))
    assert fault(capture).found == "nothing"


def test_declaration_that_is_no_object(capture):
    path = capture.union / "headbench.json"
    for text in ("[" * 200_000, "3", "{"):
        path.write_text(text)
        assert fault(capture).file == str(path)
    path.unlink()
    path.mkdir()
    assert fault(capture).file == str(path)


def test_excluded_timestep_that_does_not_exist(capture):
    assert "99" in fault(capture, exclude={99: "blur"}).found
    capture.edit(
        "headbench.json", lambda document: document["excluded"].append({"timestep": 99, "reason": ""})
    )
    error = fault(capture)
    assert (error.file, error.key) == (str(capture.union / "headbench.json"), "timestep")


def test_no_training_frame(capture):
    capture.edit(TRAIN, lambda document: document.update(frames=[]))
    error = fault(capture)
    assert error.file.endswith(TRAIN)
    assert error.key == "frames"


# ------------------------------------------------------------------ names that folders are made of

OUTSIDE = "../../outside"


def test_subject_that_leads_out_of_the_output_folder(capture):
    assert fault(capture, subject=OUTSIDE).key == "subject"
    for subject in (OUTSIDE, "/outside", ""):
        capture.edit("headbench.json", lambda document, name=subject: document.update(subject=name))
        error = fault(capture)
        assert (error.file, error.key) == (str(capture.union / "headbench.json"), "subject")


def test_sequence_that_leads_out_of_the_output_folder(capture):
    def change(document):
        document["sequences"] = dict.fromkeys(document["sequences"], OUTSIDE)

    capture.edit("headbench.json", change)
    assert fault(capture).key.startswith("sequences.")


def test_camera_that_leads_out_of_the_output_folder(capture):
    capture.edit(TRAIN, lambda document: document["frames"][1].update(camera_id=OUTSIDE))
    assert fault(capture).key == "frames[1].camera_id"


# ------------------------------------------------------------------ leaks


def test_image_copied_from_training_into_test_is_found(capture):
    source = capture.writer.image_path("EMO-1-shout+laugh", 0, SERIALS[0])
    shutil.copy(source, capture.writer.image_path("FREE", 0, SERIALS[0]))
    error = fault(capture)
    assert "1 images have the same content in train and self_reenactment" in error.found
    clip = read_capture(capture.union, leaks="record")
    assert "same content" in clip.steps[0].parameters["leaks"][0]


def test_image_file_used_in_two_splits_is_found(capture):
    train = json.loads((capture.union / TRAIN).read_text())["frames"]

    def change(document):
        document["frames"][0]["file_path"] = train[0]["file_path"]

    capture.edit("transforms_val.json", change)
    assert "1 image files are in both train and novel_view" in fault(capture).found


def test_key_in_two_splits_is_refused_even_when_leaks_are_recorded(capture):
    train = json.loads((capture.union / TRAIN).read_text())["frames"]
    capture.edit("transforms_val.json", lambda document: document["frames"].append(train[0]))
    assert fault(capture, leaks="record").key == "train and novel_view"


def test_trained_test_timesteps_and_cameras_are_leaks(tmp_path):
    def key(timestep, camera):
        return FrameKey("s", "q", timestep, camera)

    splits = {
        "train": [key(0, "a"), key(1, "b")],
        "novel_view": [key(0, "b")],
        "self_reenactment": [key(1, "c"), key(2, "c")],
    }
    images = {k: tmp_path / str(i) for i, k in enumerate(k for keys in splits.values() for k in keys)}
    for path in images.values():
        path.write_text(path.name)
    leaks = find_leaks(splits, images)
    assert len(leaks) == 2
    assert any("self-reenactment timesteps are trained on, such as 1" in leak for leak in leaks)
    assert any("novel-view cameras are trained on: b" in leak for leak in leaks)
    clean = {**splits, "novel_view": [key(0, "d")], "self_reenactment": [key(2, "c")]}
    images = dict(zip([k for keys in clean.values() for k in keys], images.values()))
    assert find_leaks(clean, images) == []
