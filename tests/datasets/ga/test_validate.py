"""Every fault of a capture is found when it is opened, and named."""

import hashlib
import json
import os
import shutil

import cv2
import numpy as np
import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.bench.io.files import digest
from headbench.datasets.ga import validate as module
from headbench.datasets.ga.layout import Declaration
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.validate import content_digests, find_leaks
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


def document(change, file=TRAIN):
    return lambda capture: capture.edit(file, change)


def declared(change):
    return document(lambda declaration: declaration.update(change), DECLARED)


def blank(path, *shape):
    write_image(path, np.zeros(shape, np.uint8))


def drop_timestep(document):
    document["frames"] = [frame for frame in document["frames"] if frame["timestep_index"] != 1]


def without_focal_length(document):
    for level in (document, document["frames"][0]):
        del level["fl_x"], level["camera_angle_x"]


def move(entry, axis, by):
    entry["transform_matrix"][axis][3] += by


def turn_camera(entry):
    if "FREE" in entry["file_path"] and entry["camera_index"] == 2:
        move(entry, 1, 0.01)


def text(file, content):
    return lambda capture: (capture.union / file).write_text(content)


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
    *(
        ("transform_matrix", np.diag([*sides, 1]).tolist())
        for sides in ([2.0, 2, 2], [1, -1, 1], [1, np.nan, 1])
    ),
    *(("fl_x", 0), ("camera_angle_x", 30.0), ("cx", "24"), ("cy", float("inf")), ("w", True)),
]
BAD_ARRAYS = [
    *(("jaw_pose", None), ("eyes_pose", np.zeros((1, 3), np.float32)), ("shape", np.zeros(300, np.float32))),
    *(("expr", np.full((1, 8), np.nan, np.float32)), ("rotation", np.array([["a", "b", "c"]]))),
    *(("static_offset", array) for array in (np.full((1, 278, 3), np.inf, np.float32), np.zeros(278 * 3))),
]
BAD_DECLARATIONS = [
    *(("format_version", 99), ("subject", 3), ("subject", OUTSIDE), ("subject", "/outside"), ("subject", "")),
    *(("background", [1, 2, 3]), ("cy", "middle"), ("sequences", {"a": 1}), ("sequences", {"a": OUTSIDE})),
    *(("excluded", [{"timestep": "1", "reason": "tongue"}]), ("synthetic", []), ("head_file", None)),
]
LEAK = "1 image of the same content in train and self_reenactment"
EMO, SEN = "EMO-1-shout+laugh", "SEN-01-cramp_small_danger"
EMO_PARAMETERS = f"../901_{EMO}_v3_whiteBg_staticOffset/flame_param/00001.npz"
BROKEN = ("", "{", '{"frames": [', "[1, 2]", '{"frames": {}}', '{"frames": [3]}')
NOTHING = {"timestep": 99, "reason": ""}
FAULTS = {
    "missing image": (lambda c: image(c, EMO, 1, SERIALS[2]).unlink(), TRAIN, "frames[3].file_path"),
    "missing mask": (lambda c: mask(c).unlink(), TEST, "frames[1].fg_mask_path"),
    "empty image": (lambda c: image(c).write_bytes(b""), "images/00000_01.png", "an empty file"),
    **{f"image cut by {n}": (lambda c, n=n: cut(image(c, SEN), -n), "truncated") for n in (1, 12, 500)},
    "no image": (lambda c: image(c).write_text("<html>not found</html>"), "PNG or JPEG"),
    "smaller image": (lambda c: blank(image(c), 32, 24, 3), "48x64 pixels", "24x32"),
    "smaller mask": (lambda c: blank(mask(c), 32, 24), "fg_masks/00000_01.png"),
    "16 bits": (lambda c: cv2.imwrite(str(image(c)), np.zeros((64, 48, 3), np.uint16)), "8 bits per channel"),
    **{f"{k} {v}"[:40]: (frame(5, **{k: v}), TRAIN, f"frames[5].{k}") for k, v in BAD_VALUES},
    "no focal length": (document(without_focal_length), "frames[0]", "fl_x or camera_angle_x"),
    "no JSON": (lambda c: (c.union / VAL).unlink(), VAL, "no such file"),
    **{f"JSON {content}": (text(TRAIN, content), TRAIN) for content in BROKEN},
    "gap in timesteps": (lambda c: [c.edit(f, drop_timestep) for f in (TRAIN, VAL)], "frame of timestep 1"),
    "timestep of two files": (frame(1, flame_param_path=EMO_PARAMETERS), ".flame_param_path"),
    "frame twice": (document(lambda d: d["frames"].append(d["frames"][0])), "2 times"),
    "no training frame": (document(lambda d: d.update(frames=[])), TRAIN, "frames"),
    "camera moves": (document(lambda d: move(d["frames"][2], 0, 0.001)), "frames[2].transform_matrix"),
    "sequences differ by more than a shift": (frames(turn_camera), "up to one shift"),
    "focal length and angle": (frames(lambda f: f.update(fl_x=2 * f["fl_x"])), "scaled with the images"),
    "serial of another index": (frame(3, camera_id=SERIALS[0]), "frames[3].camera_id"),
    "intrinsics change": (frame(3, cx=1.0), "intrinsics of camera"),
    **{f"{k}, array {i}": (array(k, v), "00001.npz", k) for i, (k, v) in enumerate(BAD_ARRAYS)},
    "parameters cut": (lambda c: cut(parameters(c), 200), "staticOffset/flame_param/00001.npz"),
    "no parameters": (lambda c: parameters(c).unlink(), "00001.npz"),
    **{f"declared {k} {v}": (declared({k: v}), DECLARED, k) for k, v in BAD_DECLARATIONS},
    "declaration without cy": (document(lambda d: d.pop("cy"), DECLARED), DECLARED, "nothing"),
    **{f"declaration {t[:9]}": (text(DECLARED, t), DECLARED) for t in ("[" * 200_000, "3", "{")},
    "exclusion of nothing": (
        document(lambda d: d["excluded"].append(NOTHING), DECLARED),
        DECLARED,
        "timestep",
    ),
    "tested image": (lambda c: shutil.copy(image(c, EMO, 0, SERIALS[0]), image(c, camera=SERIALS[0])), LEAK),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named(capture, name):
    plant, *names = FAULTS[name]
    plant(capture)
    error = fault(capture)
    assert all(text in f"{error} {error.remedy}" for text in names), error


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


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of remembered digests, where also files that were just written are remembered."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "YOUNG_NS", -(10**9))
    return tmp_path / "cache" / "headbench" / "digests"


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    for name in ("a", "b", "c"):
        (folder / name).write_text(name)
    return folder


@pytest.fixture
def reads(monkeypatch):
    """Names of the files whose bytes were read."""
    names = []
    original = module.digest_file
    monkeypatch.setattr(module, "digest_file", lambda path: names.append(path.name) or original(path))
    return names


def expected(folder):
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def test_only_what_changed_is_read_again(folder, cache, reads):
    for change in (None, None, ("b", "other"), ("c", "C")):
        if change:
            name, text = change
            before = (folder / name).stat()
            (folder / name).write_text(text)
            os.utime(folder / name, ns=(before.st_atime_ns, before.st_mtime_ns))
        else:
            name = "abc" if not cache.exists() else ""
        reads.clear()
        assert content_digests(folder.iterdir(), cached_for=folder) == expected(folder)
        assert "".join(sorted(reads)) == name
    assert sorted(path.name for path in folder.iterdir()) == ["a", "b", "c"]


def test_without_memory_every_byte_is_read(folder, cache, reads):
    content_digests(folder.iterdir(), cached_for=folder)
    for path in cache.iterdir():  # what is remembered is wrong, as it cannot be but on purpose
        entries = dict.fromkeys(json.loads(path.read_text())["entries"], "0" * 64)
        path.write_text(json.dumps({"digest": digest(entries), "entries": entries}))
    assert content_digests(folder.iterdir(), cached_for=folder) != expected(folder)
    reads.clear()
    assert content_digests(folder.iterdir()) == expected(folder)
    assert sorted(reads) == ["a", "b", "c"]


def test_a_file_that_just_changed_is_not_remembered(folder, cache, monkeypatch):
    monkeypatch.setattr(module, "YOUNG_NS", 60 * 10**9)
    content_digests(folder.iterdir(), cached_for=folder)
    assert all(json.loads(path.read_text())["entries"] == {} for path in cache.iterdir())


def upside_down(value):
    """A JSON value with the keys of its objects in the opposite order, whole numbers without a point, and no nulls added."""
    if isinstance(value, dict):
        return {key: upside_down(value[key]) for key in reversed(value)}
    if isinstance(value, list):
        return [upside_down(part) for part in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def absolute(frame, folder):
    paths = {key: str((folder / frame[key]).resolve()) for key in frame if key.endswith("_path")}
    return frame | paths | {"camera_id": int(frame["camera_id"]), "sharpness": None}


REWRITTEN = {
    "one line": ("json", lambda path, value: json.dumps(value, separators=(",", ":"))),
    "CRLF and a byte order mark": (
        "json",
        lambda path, value: "\ufeff" + json.dumps(value, indent=4).replace("\n", "\r\n"),
    ),
    "sorted keys": ("json", lambda path, value: json.dumps(value, sort_keys=True)),
    "keys in the opposite order, as JavaScript writes numbers": (
        "json",
        lambda path, value: json.dumps(upside_down(value)),
    ),
    "absolute paths, numbers as camera ids": (
        "json",
        lambda path, value: json.dumps(
            {**value, "frames": [absolute(f, path.parent) for f in value["frames"]]}
            if "frames" in value
            else value
        ),
    ),
    "compressed": ("npz", lambda stream, arrays: np.savez_compressed(stream, **arrays)),
    "arrays in the opposite order": (
        "npz",
        lambda stream, arrays: np.savez(stream, **dict(reversed(arrays.items()))),
    ),
    "Fortran's order": (
        "npz",
        lambda stream, arrays: np.savez(stream, **{k: np.asfortranarray(v) for k, v in arrays.items()}),
    ),
    "big-endian": (
        "npz",
        lambda stream, arrays: np.savez(stream, **{k: v.astype(">f4") for k, v in arrays.items()}),
    ),
}


@pytest.mark.parametrize("case", REWRITTEN)
def test_a_file_written_again_is_the_same_capture(capture, case):
    expected = read_capture(capture.union, use_cache=False).fingerprint
    suffix, write = REWRITTEN[case]
    for path in capture.union.parent.rglob(f"*.{suffix}"):
        if suffix == "json":
            path.write_text(write(path, json.loads(path.read_text())), newline="")
        elif path.parent.name == "flame_param":
            with np.load(path) as archive:
                arrays = dict(archive)
            write(path, arrays)
    assert read_capture(capture.union, use_cache=False).fingerprint == expected


def test_digests_of_own_files_are_those_of_their_bytes(pristine_capture):
    """Protocols of captures that headbench wrote keep their hashes."""
    union = pristine_capture.union
    files = [*union.parent.rglob("transforms*.json"), *union.parent.rglob("flame_param/*.npz")]
    assert content_digests(files) == {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    declaration = Declaration.read(union)
    expected = hashlib.sha256((union / "headbench.json").read_bytes()).hexdigest()
    assert declaration.digest(declaration.sequences) == expected


@pytest.mark.parametrize(
    ("key", "value"), [("timestep_index_original", 7), ("camera_angle_y", 0.1), ("note", "x")]
)
def test_another_content_is_another_capture(capture, key, value):
    expected = read_capture(capture.union, use_cache=False).fingerprint
    capture.edit("transforms_val.json", lambda document: document["frames"][0].update({key: value}))
    assert read_capture(capture.union, use_cache=False).fingerprint != expected
