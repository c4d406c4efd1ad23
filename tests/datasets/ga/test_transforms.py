"""Any JSON at all is read or refused, never crashed on."""

import json
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError
from headbench.datasets.ga import layout
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.transforms import read_transforms

BEYOND_FLOAT = 10**309
numbers = st.one_of(st.integers(), st.floats(), st.just(BEYOND_FLOAT), st.booleans(), st.none())
values = st.recursive(
    st.one_of(numbers, st.text(max_size=8), st.just("x" * 5000), st.just("a\0b")),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)
KEYS = [
    *("timestep_index", "camera_index", "camera_id", "cx", "cy", "fl_x", "fl_y", "h", "w"),
    *("camera_angle_x", "transform_matrix", "file_path", "fg_mask_path", "flame_param_path"),
]


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(key=st.sampled_from(KEYS), value=values)
@example(key="w", value=BEYOND_FLOAT)
@example(key="fl_x", value=BEYOND_FLOAT)
@example(key="transform_matrix", value=[[BEYOND_FLOAT] * 4] * 4)
@example(key="file_path", value="x" * 5000)
@example(key="flame_param_path", value="x" * 5000)
@example(key="fg_mask_path", value="a\0b")
@example(key="flame_param_path", value=".")
@example(key="file_path", value=".png")
def test_any_value_of_a_frame_is_read_or_refused(capture, key, value):
    path = capture.union / "transforms_train.json"
    original = path.read_text()
    document = json.loads(original)
    document["frames"][1][key] = value
    path.write_text(json.dumps(document))
    with suppress(InputError):
        read_capture(capture.union)
    path.write_text(original)


@pytest.mark.parametrize("everywhere", [False, True])
@pytest.mark.parametrize(
    ("lens", "refused"),
    [
        *(
            ({"k1": -0.35}, "k1"),
            ({"k1": "0.1"}, "k1"),
            ({"K1": 0.1}, "K1"),
            ({"is_fisheye": True}, "is_fisheye"),
        ),
        *(
            ({"distortion_params": [0.0, 0.1]}, "distortion_params"),
            ({"dist_coeffs": [0.1, 0]}, "dist_coeffs"),
        ),
        ({"camera_model": "OPENCV", "k1": 0.0, "p2": 1e-4}, "p2"),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.0}, "camera_model"),
        ({"camera_model": "OPENCV", "k1": 0, "k2": 0.0, "p1": 0, "p2": 0, "is_fisheye": False}, None),
        ({"camera_model": "PINHOLE", "k3": None, "distortion_params": [0, 0, 0]}, None),
    ],
)
def test_lenses_that_are_no_pinhole_are_refused(capture, lens, refused, everywhere):
    """Their images would be compared with renders of a pinhole without a word."""
    if everywhere:
        capture.edit("transforms_train.json", lambda document: document.update(lens))
    else:
        capture.edit("transforms_train.json", lambda document: document["frames"][-1].update(lens))
    if refused is None:
        read_capture(capture.union)
        return
    with pytest.raises(InputError, match=r"undistort|distortion") as caught:
        read_capture(capture.union)
    assert caught.value.key.rpartition(".")[2] == refused


def test_size_and_intrinsics_may_stand_at_the_top_level(tmp_path):
    frame = {
        "timestep_index": 0.0,  # some writers store whole numbers as floats
        "file_path": "./images/0",
        "flame_param_path": "flame_param/00000.npz",
        "transform_matrix": np.eye(4).tolist(),
    }
    document = {"frames": [frame], "camera_angle_x": 0.5, "w": 40, "h": 30, "cx": 19.0}
    path = tmp_path / "transforms_train.json"
    path.write_text(json.dumps(document))
    (entry,) = read_transforms(path)
    assert entry.intrinsics == {"camera_angle_x": 0.5, "cx": 19.0}
    assert (entry.width, entry.height, entry.timestep, entry.camera_id) == (40, 30, 0, "00")
    assert entry.image == tmp_path / "images" / "0.png"
    assert entry.sequence_folder == tmp_path.name
    frame["cx"] = 21.0
    path.write_text(json.dumps(document))
    assert read_transforms(path)[0].intrinsics["cx"] == 21.0


SPELLINGS = {
    "absolute": lambda folder, path: (folder / path).resolve().as_posix(),
    "from two folders up": lambda folder, path: f"../../{folder.parent.name}/{path[3:]}",
    "through the folder itself": lambda folder, path: f"../{folder.name}/.././{path[3:]}",
    "through a link": lambda folder, path: f"linked/{path[3:]}",
    "with backslashes": lambda folder, path: path.replace("/", "\\"),
    "one absolute, one not": lambda folder, path: (
        (folder / path).resolve().as_posix() if path.endswith("00000.npz") else path
    ),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_sequences_are_those_of_the_parameters(capture, spelling):
    """Each frame belongs to the sequence whose parameters it names, however the path is spelled."""
    expected = read_capture(capture.union)
    (capture.union / "linked").symlink_to("..")

    def spell(frame):
        for key in ("file_path", "fg_mask_path", "flame_param_path"):
            if spelling != "one absolute, one not" or frame["camera_index"]:
                frame[key] = SPELLINGS[spelling](capture.union, frame[key])

    for file in ("transforms_train.json", "transforms_val.json", "transforms_test.json"):
        capture.edit(file, lambda document: [*map(spell, document["frames"])])
    found = read_capture(capture.union)
    assert found.splits == expected.splits
    assert len({key.sequence for key in found.files}) == 3


@pytest.mark.parametrize(
    ("key", "value", "attribute", "expected"),
    [
        ("camera_id", 222200037, "camera_id", "222200037"),
        ("camera_id", 7.0, "camera_id", "7"),
        ("camera_id", None, "camera_id", "02"),
        ("camera_index", 2.0, "camera_index", 2),
        ("timestep_index", 3.0, "timestep", 3),
        ("w", 48.0, "width", 48),
        ("fl_x", None, "intrinsics", {"camera_angle_x": 0.5}),
        ("fl_x", 90, "intrinsics", {"camera_angle_x": 0.5, "fl_x": 90.0}),
        ("fg_mask_path", None, "mask", None),
        ("flame_param_path", "../SEQ/flame/12.npz", "sequence_folder", "here"),
        ("flame_param_path", "flame_param/EXP-1/12.npz", "sequence_folder", "here"),
        ("flame_param_path", "D:\\074_EXP-1\\flame_param\\12.npz", "sequence_folder", "074_EXP-1"),
        ("flame_param_path", "EXP-1/flame_param/12.npz", "sequence_folder", "EXP-1"),
    ],
)
def test_entries_as_other_programs_write_them(tmp_path, key, value, attribute, expected):
    (tmp_path / "here").mkdir()
    assert getattr(only_entry(tmp_path / "here", **{key: value}), attribute) == expected


@pytest.mark.parametrize(
    ("image", "parameters", "folder"),
    [
        ("../SEQ/images/0.png", "../SEQ/tracked/0.npz", "SEQ"),
        ("images/SEQ/0.png", "tracked/SEQ/0.npz", "here"),
        ("../SEQ/images/0.png", "../tracking/SEQ/0.npz", "SEQ"),
    ],
)
def test_the_sequence_folder_holds_images_or_parameters(tmp_path, image, parameters, folder):
    (tmp_path / "here").mkdir()
    entry = only_entry(tmp_path / "here", file_path=image, flame_param_path=parameters)
    assert entry.sequence_folder == folder


def only_entry(folder, **values):
    """The entry of a JSON with one frame, which has these values."""
    frame = {"timestep_index": 1, "camera_index": 2, "camera_angle_x": 0.5, "file_path": "images/0.png"}
    frame |= {"flame_param_path": "flame_param/0.npz", "transform_matrix": np.eye(4).tolist()}
    (folder / "transforms.json").write_text(json.dumps({"frames": [frame | values]}))
    return read_transforms(folder / "transforms.json")[0]


def test_paths_with_backslashes_and_a_byte_order_mark_are_read(capture):
    path = capture.union / "transforms_train.json"
    expected = [(entry.image, entry.mask, entry.parameters) for entry in read_transforms(path)]

    def change_back(frame):
        for key in ("file_path", "fg_mask_path", "flame_param_path"):
            frame[key] = frame[key].replace("/", "\\")

    capture.each_frame(change_back)
    for file in capture.union.glob("*.json"):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    assert [(entry.image, entry.mask, entry.parameters) for entry in read_transforms(path)] == expected
    read_capture(capture.union)


finite = st.floats(-3, 3)


@settings(deadline=None)
@given(
    axis=st.tuples(finite, finite, finite),
    place=st.tuples(finite, finite, finite),
    focal=st.tuples(st.floats(10, 9000), st.floats(10, 9000)),
    center=st.tuples(st.floats(0, 550), st.floats(0, 802)),
    cy=st.sampled_from(["top", "bottom"]),
)
def test_cameras_survive_the_json(axis, place, focal, center, cy):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(axis).as_matrix(), place
    K = np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])
    camera = Camera("c", 550, 802, K, matrix)
    entries = layout.intrinsics_to_json(camera, cy)
    np.testing.assert_allclose(layout.intrinsics_from_json(entries, 550, 802, cy), K, rtol=0, atol=1e-12)
    stored = np.array(layout.extrinsics_to_json(matrix))
    np.testing.assert_allclose(layout.extrinsics_from_json(stored), matrix, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("folder", "subject", "sequence"),
    [
        ("074_EMO-1_v16_DS4_whiteBg_staticOffset_maskBelowLine", "074", "EMO-1"),
        ("074_EMO-1-shout+laugh_v16_DS4_whiteBg", "074", "EMO-1-shout+laugh"),
        ("306_SEN-01-cramp_small_danger_v16_DS2-0.5x_lmkSTAR", "306", "SEN-01-cramp_small_danger"),
        ("306_FREE", "306", "FREE"),
        ("901_FREE_v3_whiteBg_staticOffset", "901", "FREE"),
        ("306_EXP-3-cheeks+nose_v8", "306", "EXP-3-cheeks+nose"),
        ("obama", "", "obama"),
    ],
)
def test_sequence_folder_names(folder, subject, sequence):
    assert layout.parse_sequence_folder(folder) == (subject, sequence)


@pytest.mark.parametrize(
    ("folder", "subject"),
    [
        *(("UNION10_306_EMO1234EXP234589_v16_DS2-0.5x_lmkSTAR_teethV3_SMOOTH", "306"), ("UNION_074", "074")),
        *(("UNION20_a1", "a1"), ("074_EMO-1_v16", "")),
    ],
)
def test_union_folder_names(folder, subject):
    assert layout.parse_union_folder(folder) == subject


def test_declaration_survives(tmp_path):
    declaration = layout.Declaration(
        subject="s",
        head_model="procedural2023",
        background=(0.25, 0.5, 1.0),
        cy="top",
        sequences={"s_FREE_v16": "FREE"},
        excluded={12: "tongue out", 3: "blur"},
        synthetic={"seed": 7},
    )
    declaration.write(tmp_path)
    assert layout.Declaration.read(tmp_path) == declaration
    assert layout.Declaration.read(tmp_path / "elsewhere") is None
