"""The written files against the facts known of VHAP's export."""

import json

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga.writer import CaptureWriter, write_union

from ..tiny_capture import FRONTAL, make_plan, paint

UNION_FRAME_KEYS = [
    *("timestep_index", "camera_index", "camera_id", "cx", "cy", "fl_x", "fl_y", "h", "w", "camera_angle_x"),
    *("camera_angle_y", "transform_matrix", "file_path", "fg_mask_path", "flame_param_path"),
]
TOP_LEVEL_KEYS = {
    *("frames", "cx", "cy", "fl_x", "fl_y", "h", "w", "camera_angle_x", "camera_angle_y"),
    *("timestep_indices", "camera_indices"),
}
PARAMETER_SHAPES = {
    **dict.fromkeys(("translation", "rotation", "neck_pose", "jaw_pose"), (1, 3)),
    "eyes_pose": (1, 6),
}


def read(path):
    return json.loads(path.read_text())


def test_union_jsons_have_the_layouts_keys_and_relative_paths(pristine_capture):
    union = pristine_capture.union
    for file in ("transforms_train.json", "transforms_val.json", "transforms_test.json"):
        document = read(union / file)
        assert document.keys() == TOP_LEVEL_KEYS
        for frame in document["frames"]:
            assert sorted(frame) == sorted(UNION_FRAME_KEYS)
            for key in ("file_path", "fg_mask_path", "flame_param_path"):
                assert frame[key].startswith("../901_")
                assert (union / frame[key]).is_file()
    assert not (union / "transforms.json").exists()
    assert (union / "canonical_flame_param.npz").is_file()


def test_sequence_jsons_add_original_index_and_id(pristine_capture):
    folder = pristine_capture.writer.sequence_folder("FREE")
    frames = read(folder / "transforms.json")["frames"]
    assert sorted(frames[0]) == sorted([*UNION_FRAME_KEYS, "timestep_index_original", "timestep_id"])
    assert [(f["timestep_index"], f["camera_index"]) for f in frames] == [
        (t, c) for t in range(3) for c in range(3)
    ]
    parts = [read(folder / f"transforms_{part}.json")["frames"] for part in ("train", "val", "test")]
    # ceil(0.7 * 3) = 3 timesteps train; the middle camera is the novel view.
    assert [len(part) for part in parts] == [6, 3, 0]
    assert {f["camera_id"] for f in parts[1]} == {FRONTAL}


def test_the_union_numbers_training_sequences_first(pristine_capture):
    union = pristine_capture.union
    train, val, test = (read(union / f"transforms_{part}.json") for part in ("train", "val", "test"))
    assert train["timestep_indices"] == val["timestep_indices"] == [0, 1, 2, 3]
    assert test["timestep_indices"] == [4, 5, 6]
    assert {f["camera_id"] for f in val["frames"]} == {FRONTAL}
    assert FRONTAL not in {f["camera_id"] for f in train["frames"]}
    assert test["camera_indices"] == [0, 1, 2]
    assert all("/901_FREE_" in f["file_path"] for f in test["frames"])
    assert (union / "sequences_test.txt").read_text().split() == ["901_FREE_v3_whiteBg_staticOffset"]
    assert len((union / "sequences_trainval.txt").read_text().split()) == 2


def test_camera_is_opengl_with_cy_from_the_bottom(pristine_capture):
    camera = pristine_capture.writer.plan.cameras[0]
    frame = read(pristine_capture.union / "transforms_train.json")["frames"][0]
    matrix = np.array(frame["transform_matrix"])
    np.testing.assert_allclose(matrix[:3, 3], camera.center, atol=1e-15)
    # OpenGL cameras look along their own -z: at the head, which is at the origin.
    np.testing.assert_allclose(-matrix[:3, 2], -camera.center / np.linalg.norm(camera.center), atol=1e-12)
    assert matrix[1, 1] > 0.9  # y is up
    assert frame["cy"] == pytest.approx(64 - 29.3)
    assert frame["cx"] == pytest.approx(24.7)
    assert np.tan(frame["camera_angle_x"] / 2) == pytest.approx(48 / (2 * frame["fl_x"]))
    assert np.tan(frame["camera_angle_y"] / 2) == pytest.approx(64 / (2 * frame["fl_y"]))


def test_parameter_files_have_the_layouts_arrays(pristine_capture):
    plan = pristine_capture.writer.plan
    vertices, _, identities = plan.head.shape_basis.shape
    shapes = PARAMETER_SHAPES | {
        "shape": (identities,),
        "expr": (1, plan.head.expression_basis.shape[2]),
        "static_offset": (1, vertices, 3),
    }
    folder = pristine_capture.writer.sequence_folder("FREE")
    for path in [*sorted(folder.glob("flame_param/*.npz")), folder / "canonical_flame_param.npz"]:
        with np.load(path, allow_pickle=False) as arrays:
            assert {key: arrays[key].shape for key in arrays.files} == shapes
            float64 = {key for key in arrays.files if arrays[key].dtype != np.float32}
        assert float64 == ({"jaw_pose"} if path.name.startswith("canonical") else set())
    with np.load(folder / "canonical_flame_param.npz", allow_pickle=False) as arrays:
        assert arrays["jaw_pose"].tolist() == [[0.3, 0, 0]]
        assert not arrays["expr"].any()
        np.testing.assert_array_equal(arrays["shape"], plan.shape)


def test_metadata_waits_for_every_image_in_its_size(tmp_path):
    plan = make_plan(lengths={"FREE": 1, "EMO-1-shout+laugh": 1})
    writer = CaptureWriter(tmp_path, plan)
    keys = [(s.name, t, c.id) for s in plan.sequences for t in range(len(s.poses)) for c in plan.cameras]
    images = {k: paint(plan, plan.sequence(k[0]).poses[k[1]], plan.cameras[0], i) for i, k in enumerate(keys)}
    for key in keys[:-1]:
        writer.write_frame(*key, *images[key])
    with pytest.raises(InputError, match="00000_02.png: expected an image file, found no such file"):
        writer.write_metadata()
    assert not list(tmp_path.rglob("*.json"))
    writer.write_frame(*keys[-1], np.zeros((60, 48, 3), np.uint8))
    with pytest.raises(InputError, match="expected 48x64 pixels.*found 48x60"):
        writer.write_metadata()
    writer.write_frame(*keys[-1], *images[keys[-1]])
    assert (writer.write_metadata() / "transforms_train.json").is_file()
    assert not [path for path in tmp_path.rglob(".*") if path.is_file()]  # no temporary file left behind


@pytest.mark.parametrize(
    "change",
    [{"subject": "a_b"}, {"test_sequences": ("FREE", "EMO-1-shout+laugh", "SEN-01-cramp_small_danger")}],
)
def test_what_the_layout_cannot_hold_is_refused(change):
    with pytest.raises(InputError, match=next(iter(change))):
        make_plan(**change)


def test_a_union_joins_sequences_with_absolute_paths(capture):
    """Its own paths are relative, as in every union."""
    folders = [
        capture.writer.sequence_folder(sequence.name) for sequence in capture.writer.plan.sequences[:2]
    ]
    for folder in folders:
        document = read(folder / "transforms.json")
        for frame in document["frames"]:
            frame |= {key: str(folder / frame[key]) for key in frame if key.endswith("_path")}
        (folder / "transforms.json").write_text(json.dumps(document))
    union = capture.union.with_name("UNION_again")
    write_union(union, folders[:1], folders[1:], [], None)
    for frame in read(union / "transforms_test.json")["frames"]:
        for key in ("file_path", "fg_mask_path", "flame_param_path"):
            assert frame[key].startswith(f"../{folders[1].name}/")
            assert (union / frame[key]).is_file()
