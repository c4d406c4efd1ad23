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

from ..tiny_capture import FRONTAL, SERIALS, edit_npz

TRAIN, VAL, TEST = (f"transforms_{part}.json" for part in ("train", "val", "test"))
DECLARED = "headbench.json"
OUTSIDE = "../../outside"


def fault(capture, **settings) -> InputError:
    """The error that opening the capture raises; always one paragraph."""
    with pytest.raises(InputError) as caught:
        read_capture(capture.union, **settings)
    assert "\n" not in str(caught.value)
    return caught.value


def image(capture, sequence="FREE", timestep=0, camera=FRONTAL):
    return capture.writer.image_path(sequence, timestep, camera)


def mask(capture):
    return capture.writer.mask_path("FREE", 0, FRONTAL)


def parameters(capture):
    return capture.writer.sequence_folder("FREE") / "flame_param" / "00001.npz"


def cut(path, end):
    path.write_bytes(path.read_bytes()[:end])


def frame(index, file=TRAIN, **changes):
    """Change a frame; None leaves a key out."""

    def plant(capture):
        def change(document):
            entry = document["frames"][index]
            entry.update(changes)
            for key in [key for key, value in changes.items() if value is None]:
                del entry[key]

        capture.edit(file, change)

    return plant


def frames(change):
    return lambda capture: capture.each_frame(change)


def document(file, change):
    return lambda capture: capture.edit(file, change)


def drop_timestep(document):
    document["frames"] = [frame for frame in document["frames"] if frame["timestep_index"] != 1]


def without_focal_length(document):
    for level in (document, document["frames"][0]):
        del level["fl_x"], level["camera_angle_x"]


def move(entry, axis, by):
    entry["transform_matrix"][axis][3] += by


def array(key, value):
    """Exchange an array of a parameter file; None leaves it out."""

    def change(arrays):
        arrays.pop(key)
        arrays.update({} if value is None else {key: value})

    return lambda capture: edit_npz(parameters(capture), change)


BAD_VALUES = [
    *(("timestep_index", None), ("timestep_index", 1.5), ("timestep_index", "1"), ("camera_index", -1)),
    *(("camera_id", 222200037), ("camera_id", OUTSIDE), ("file_path", None), ("flame_param_path", None)),
    *(("transform_matrix", None), ("transform_matrix", [[1, 0], [0, 1]])),
    *(("transform_matrix", [[1, 0, 0, 0], [0, 1]]), ("transform_matrix", [["a"] * 4] * 4)),
    ("transform_matrix", np.diag([2.0, 2, 2, 1]).tolist()),
    ("transform_matrix", np.diag([1.0, -1, 1, 1]).tolist()),
    ("transform_matrix", np.diag([1.0, np.nan, 1, 1]).tolist()),
    *(("fl_x", 0), ("camera_angle_x", 30.0), ("cx", "24"), ("cy", float("inf")), ("w", True)),
]
BAD_ARRAYS = [
    ("jaw_pose", None),
    ("eyes_pose", np.zeros((1, 3), np.float32)),
    ("expr", np.full((1, 8), np.nan, np.float32)),
    ("static_offset", np.full((1, 278, 3), np.inf, np.float32)),
    ("static_offset", np.zeros(278 * 3, np.float32)),
    ("shape", np.zeros(300, np.float32)),
    ("rotation", np.array([["a", "b", "c"]])),
]
BAD_DECLARATIONS = [
    *(("format_version", 99), ("subject", 3), ("subject", OUTSIDE), ("subject", "/outside"), ("subject", "")),
    *(("background", [1, 2, 3]), ("cy", "middle"), ("sequences", {"a": 1}), ("sequences", {"a": OUTSIDE})),
    *(("excluded", [{"timestep": "1", "reason": "tongue"}]), ("synthetic", []), ("head_file", None)),
]
FAULTS = {
    "missing image": (
        lambda c: image(c, "EMO-1-shout+laugh", 1, SERIALS[2]).unlink(),
        {"file": TRAIN, "key": "frames[3].file_path", "found": "00001_02.png"},
    ),
    "missing mask": (lambda c: mask(c).unlink(), {"file": TEST, "key": "frames[1].fg_mask_path"}),
    "empty image": (
        lambda c: image(c).write_bytes(b""),
        {"file": "images/00000_01.png", "found": "an empty file"},
    ),
    **{
        f"image cut by {lost}": (
            lambda c, lost=lost: cut(image(c, "SEN-01-cramp_small_danger"), -lost),
            {"file": "images/00000_01.png", "found": "a truncated file"},
        )
        for lost in (1, 12, 500)
    },
    "no image": (lambda c: image(c).write_text("<html>not found</html>"), {"expected": "PNG or JPEG"}),
    "image of another size": (
        lambda c: write_image(image(c), np.zeros((32, 24, 3), np.uint8)),
        {"expected": "48x64 pixels", "found": "24x32"},
    ),
    "mask of another size": (
        lambda c: write_image(mask(c), np.zeros((32, 24), np.uint8)),
        {"file": "fg_masks/00000_01.png"},
    ),
    "16 bits": (
        lambda c: cv2.imwrite(str(image(c)), np.zeros((64, 48, 3), np.uint16)),
        {"expected": "8 bits per channel"},
    ),
    **{
        f"{key} {value}"[:40]: (
            frame(5, **{key: value}),
            {"file": TRAIN, "key": f"frames[5].{key}"} | ({"found": "no such key"} if value is None else {}),
        )
        for key, value in BAD_VALUES
    },
    "no focal length": (
        document(TRAIN, without_focal_length),
        {"key": "frames[0]", "expected": "fl_x or camera_angle_x"},
    ),
    "no JSON": (lambda c: (c.union / VAL).unlink(), {"file": VAL, "found": "no such file"}),
    **{
        f"JSON {text}": (lambda c, text=text: (c.union / TRAIN).write_text(text), {"file": TRAIN})
        for text in ("", "{", '{"frames": [', "[1, 2]", '{"frames": {}}', '{"frames": [3]}')
    },
    "gap in timesteps": (
        lambda c: [c.edit(file, drop_timestep) for file in (TRAIN, VAL)],
        {"key": "timestep_index", "found": "no frame of timestep 1"},
    ),
    "timestep of two files": (
        frame(1, flame_param_path="../901_EMO-1-shout+laugh_v3_whiteBg_staticOffset/flame_param/00001.npz"),
        {"key": ".flame_param_path"},
    ),
    "frame twice": (document(TRAIN, lambda d: d["frames"].append(d["frames"][0])), {"found": "2 times"}),
    "no training frame": (document(TRAIN, lambda d: d.update(frames=[])), {"file": TRAIN, "key": "frames"}),
    "camera moves": (
        document(TRAIN, lambda d: move(d["frames"][2], 0, 0.001)),
        {"key": "frames[2].transform_matrix"},
    ),
    "sequences differ by more than a shift": (
        frames(lambda f: "FREE" in f["file_path"] and f["camera_index"] == 2 and move(f, 1, 0.01)),
        {"expected": "up to one shift"},
    ),
    "focal length against the angle": (
        frames(lambda f: f.update(fl_x=2 * f["fl_x"])),
        {"remedy": "not scaled with the images"},
    ),
    "serial of another index": (frame(3, camera_id=SERIALS[0]), {"key": "frames[3].camera_id"}),
    "intrinsics change": (frame(3, cx=1.0), {"expected": "intrinsics of camera"}),
    **{
        f"{key}, array {i}": (array(key, value), {"file": "00001.npz", "key": key})
        for i, (key, value) in enumerate(BAD_ARRAYS)
    },
    "parameters cut": (
        lambda c: cut(parameters(c), 200),
        {"file": "../901_FREE_v3_whiteBg_staticOffset/flame_param/00001.npz"},
    ),
    "no parameters": (lambda c: parameters(c).unlink(), {"file": "00001.npz"}),
    **{
        f"declared {key} {value}": (
            document(DECLARED, lambda d, key=key, value=value: d.update({key: value})),
            {"file": DECLARED, "key": key},
        )
        for key, value in BAD_DECLARATIONS
    },
    "declaration without cy": (
        document(DECLARED, lambda d: d.pop("cy")),
        {"file": DECLARED, "found": "nothing"},
    ),
    **{
        f"declaration {text[:9]}": (
            lambda c, text=text: (c.union / DECLARED).write_text(text),
            {"file": DECLARED},
        )
        for text in ("[" * 200_000, "3", "{")
    },
    "declared exclusion of nothing": (
        document(DECLARED, lambda d: d["excluded"].append({"timestep": 99, "reason": ""})),
        {"file": DECLARED, "key": "timestep"},
    ),
    "image copied into the test": (
        lambda c: shutil.copy(image(c, "EMO-1-shout+laugh", 0, SERIALS[0]), image(c, camera=SERIALS[0])),
        {"found": "1 image of the same content in train and self_reenactment"},
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named(capture, name):
    plant, wanted = FAULTS[name]
    plant(capture)
    error = fault(capture)
    for attribute, text in wanted.items():
        assert text in getattr(error, attribute), attribute


def test_settings_are_checked_too(capture):
    assert fault(capture, subject=OUTSIDE).key == "subject"
    assert "99" in fault(capture, exclude={99: "blur"}).found
    path = image(capture)
    data = bytearray(path.read_bytes())
    data[60:90] = bytes(30)
    path.write_bytes(bytes(data))
    error = fault(capture, decode=True)
    assert (error.file, error.found) == (
        str(capture.union / f"../901_FREE_v3_whiteBg_staticOffset/images/{path.name}"),
        "damaged data",
    )
    (capture.union / DECLARED).unlink()
    (capture.union / DECLARED).mkdir()
    assert fault(capture).file == str(capture.union / DECLARED)


def test_leaks_can_be_recorded_but_no_key_in_two_splits(capture):
    shutil.copy(image(capture, "EMO-1-shout+laugh", 0, SERIALS[0]), image(capture, camera=SERIALS[0]))
    clip = read_capture(capture.union, leaks="record")
    assert "same content" in clip.steps[0].parameters["leaks"][0]
    train = json.loads((capture.union / TRAIN).read_text())["frames"]
    file_of_val = json.loads((capture.union / VAL).read_text())["frames"][0]["file_path"]
    frame(0, VAL, file_path=train[0]["file_path"])(capture)
    assert "1 image files are in both train and novel_view" in fault(capture).found
    frame(0, VAL, file_path=file_of_val)(capture)
    capture.edit(VAL, lambda document: document["frames"].append(train[0]))
    assert fault(capture, leaks="record").key == "train and novel_view"


def test_trained_test_timesteps_and_cameras_are_leaks(tmp_path):
    def leaks(**splits):
        keys = {name: [FrameKey("s", "q", *place) for place in places] for name, places in splits.items()}
        images = {k: tmp_path / f"{i}" for i, k in enumerate(k for part in keys.values() for k in part)}
        for path in images.values():
            path.write_text(path.name)
        return find_leaks(keys, images)

    train = [(0, "a"), (1, "b")]
    found = leaks(train=train, novel_view=[(0, "b")], self_reenactment=[(1, "c"), (2, "c")])
    assert len(found) == 2
    assert any("self-reenactment timesteps are trained on, such as 1" in leak for leak in found)
    assert any("novel-view cameras are trained on: b" in leak for leak in found)
    assert leaks(train=train, novel_view=[(0, "d")], self_reenactment=[(2, "c")]) == []
