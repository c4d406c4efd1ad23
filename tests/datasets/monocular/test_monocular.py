"""Videos written in the layouts of INSTA and IMavatar show what the capture they are made of shows."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.conformance.command import check_clip
from headbench.bench.contracts import no_progress
from headbench.bench.errors import InputError
from headbench.bench.protocol import make_protocols
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.lint.catalogue import errors
from headbench.datasets.monocular.clip import CONVENTION, _last
from headbench.datasets.monocular.reader import find_videos, read_video
from headbench.datasets.open import find_reader, open_clip

from ..head.toy import toy_head
from ..tiny_capture import edit_json, in_camera, make_plan, rig, write_tiny_capture
from .videos import HEAD_FILE, recording_of, write_imavatar, write_insta

LENGTHS = {"FREE": 4, "EMO-1-shout+laugh": 4, "SEN-01-port": 4}
KINDS = ["insta", "insta, meshes", "insta, eyelids", "imavatar"]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    made = {}
    for lids in (False, True):
        head = toy_head(16, eyelids=lids)
        made[lids] = recording_of(tmp_path_factory.mktemp("capture"), LENGTHS, head=head)
    return made


@pytest.fixture(scope="module")
def written(recordings, tmp_path_factory):
    root = tmp_path_factory.mktemp("videos")
    write_insta(recordings[False], root / "insta", test=3)
    write_insta(recordings[False], root / "insta, meshes", parameters=("exp",))
    write_insta(recordings[True], root / "insta, eyelids")
    write_imavatar(recordings[False], root / "imavatar" / "imavatar", ["MVI_1810", "MVI_1812"])
    return root


def folder_of(written, kind):
    return find_videos(written / kind)[0]


@pytest.fixture
def copied(written, tmp_path):
    """Copy a video, which a test may damage."""
    return lambda kind: shutil.copytree(folder_of(written, kind), tmp_path / "copied")


@pytest.mark.parametrize("kind", KINDS)
def test_a_video_shows_what_its_capture_shows(recordings, written, kind):
    recording = recordings["eyelids" in kind]
    clip = open_clip(folder_of(written, kind))
    assert clip.steps[0].name == "read_video"
    (camera,) = clip.cameras.values()
    np.testing.assert_allclose(camera.K, recording.camera.K, atol=1e-9)
    np.testing.assert_allclose(clip.shape, recording.clip.shape, atol=1e-4)
    keys = sorted((key for part in clip.splits.values() for key in part), key=lambda key: key.timestep)
    assert [key.timestep for key in keys] == [*range(12)]
    for key, source in zip(keys, recording.keys):
        found, truth = clip.poses[key.timestep], recording.pose(source)
        for name in ("expression", "jaw", "eyes"):
            np.testing.assert_allclose(getattr(found, name), getattr(truth, name), atol=1e-4, err_msg=name)
        if "eyelids" in kind:
            np.testing.assert_allclose(found.eyelids, truth.eyelids, atol=1e-4)
        np.testing.assert_allclose(
            seen(clip, camera, found), seen(recording.clip, recording.camera, truth), atol=1e-6
        )
        np.testing.assert_array_equal(clip.mask(key), recording.clip.mask(source))
        difference = clip.image(key).astype(int) - recording.clip.image(source)
        assert np.abs(difference).max() <= 1
    assert check_clip(clip) == []
    assert errors(clip) == []


def test_eyelids_without_a_basis_are_said(tmp_path, caplog):
    """The meshes blink; a head model that cannot is told from one that can."""
    head = toy_head(16)
    basis = np.zeros((*head.template.shape, 2))
    for side, name in enumerate(("left_eye_region", "right_eye_region")):
        basis[head.regions[name], 1, side] = -0.008
    recording = recording_of(tmp_path / "capture", LENGTHS, head=replace(head, eyelid_basis=basis))
    write_insta(recording, tmp_path / "video")
    able = read_video(tmp_path / "video")
    assert able.steps[0].parameters["eyelids"].startswith("from meshes, closed by up to 0.")
    assert "eyelids" not in caplog.text
    clip = read_video(tmp_path / "video", head=head)
    assert "the head model has no basis; vertices lie up to" in clip.steps[0].parameters["eyelids"]
    assert "Put l_eyelid.npy and r_eyelid.npy" in caplog.text


def test_a_file_of_another_tool_is_not_taken_for_imavatars(tmp_path):
    """LAM's flame_params.json has arrays by name and lists no frames."""
    file = tmp_path / "flame_params.json"
    file.write_text(json.dumps({"shape": [0.0], "expr": [{"expr0": 0.0}], "rotation": [[0.0, 0.0, 0.0]]}))
    assert find_videos(tmp_path) == []
    for text in ('{"frames": []}', "{"):  # IMavatar's, or damaged, which its reader says
        file.write_text(text)
        assert find_videos(tmp_path) == [tmp_path]


def seen(clip, camera, pose):
    """(V, 3) vertices before the camera, metres."""
    vertices = PosedSubject(clip.head, clip.shape, clip.static_offset).meshes([pose])[0]
    return in_camera(vertices, camera)


def test_one_camera_serves_all_and_is_that_of_the_first_frame(written):
    clip = open_clip(folder_of(written, "insta"))
    assert list(clip.cameras) == ["0"]
    first = clip.poses[0]
    assert not np.any([first.rotation, first.translation])
    assert any(np.any(pose.rotation) for pose in clip.poses.values())


@pytest.mark.parametrize(
    ("kind", "settings", "held_out", "said"),
    [
        ("insta", {}, 3, "according to the folder's split"),
        ("insta", {"held_out_frames": 5}, 5, "as asked for"),
        ("insta, meshes", {}, 3, "a quarter: fewer than the 350"),
        ("imavatar", {"held_out_sequences": ["MVI_1812"]}, 6, "videos MVI_1812"),
    ],
)
def test_the_last_frames_by_name_are_held_out(written, kind, settings, held_out, said):
    clip = open_clip(folder_of(written, kind), settings=settings)
    assert clip.timesteps("self_reenactment") == [*range(12 - held_out, 12)]
    assert clip.timesteps("train") == [*range(12 - held_out)]
    assert clip.splits["novel_view"] == ()
    sequences = {name: {key.sequence for key in keys} for name, keys in clip.splits.items()}
    assert not sequences["train"] & sequences["self_reenactment"]
    assert said in clip.steps[0].parameters["held_out"]
    assert "one camera" in clip.steps[0].parameters["novel_view"]


@pytest.mark.parametrize(("frames", "held_out"), [(4000, CONVENTION), (700, CONVENTION), (699, 174), (8, 2)])
def test_the_convention_is_350_frames_of_at_least_700(frames, held_out):
    assert _last(frames, None)[0] == held_out


def test_each_reader_takes_its_own_folders(written, pristine_capture):
    assert find_reader(folder_of(written, "insta")).name == "monocular"
    assert find_reader(written / "imavatar").name == "monocular"
    assert find_reader(pristine_capture.union).name == "ga"
    assert find_videos(written)[:3] == [written / name for name in sorted(KINDS)[1:]]
    with pytest.raises(InputError, match="reader monocular"):
        read_capture(folder_of(written, "insta"))


def each(document, **entries):
    for frame in document["frames"]:
        frame.update(entries)


def of_first(name, value):
    return lambda document: document["frames"][0].update({name: value})


INSTA_FAULTS = {
    "two frames of one name": (of_first("file_path", "images/00002.png"), "every frame once"),
    "no number": (of_first("file_path", "images/first.png"), "named by the frame's number"),
    "no image": (of_first("file_path", "images/00099.png"), "00099.png"),
    "no matrix": (of_first("transform_matrix", None), "transform_matrix"),
    "scaled": (of_first("transform_matrix", (2 * np.eye(4)).tolist()), "rigid"),
    "a focal length of its own": (of_first("fl_x", 99.0), "intrinsics of the first frame"),
    "another size": (lambda document: document.update(w=512.0), "expected 48"),
    "text": (lambda document: document.update(fl_x="far"), "fl_x"),
    "negative": (lambda document: document.update(fl_x=-1.0), "positive focal length"),
    "too large": (lambda document: document.update(fl_x=10**400), "magnitude|finite"),
    "VHAP's meshes": (lambda document: each(document, timestep_index=0), "--flame-mode param"),
    "no frames": (lambda document: document.update(frames=[]), "at least one frame"),
}


FILE_FAULTS = {
    "exp text": ("flame/exp/00003.txt", b"1.0\nfoo\n", "numbers, one a line"),
    "exp long": ("flame/exp/00003.txt", b"1.0\n" * 20, "at most 8 coefficients"),
    "exp nan": ("flame/exp/00003.txt", b"nan\n", "finite"),
    "jaw short": ("flame/jaw/00003.txt", b"1 0 0 0", "6 numbers"),
    "jaw flat": ("flame/jaw/00003.txt", b"1 0 0 1 0 0", "different directions"),
    "mesh short": ("canonical.obj", b"v 0 0 0\n", "278 vertices"),
    "mesh text": ("canonical.obj", b"v a b c\n" * 278, "three numbers"),
    "mesh gone": ("canonical.obj", None, "canonical.obj"),
    "exp gone": ("flame/exp/00003.txt", None, "00003.txt"),
}


@pytest.mark.parametrize("kind", ["insta, meshes", "imavatar"])
def test_files_with_other_white_space_are_the_same_video(copied, kind):
    folder = copied(kind)
    expected = read_video(folder, use_cache=False).fingerprint
    for path in folder.rglob("*"):
        if path.suffix == ".json":
            path.write_text(json.dumps(dict(reversed(json.loads(path.read_text()).items()))))
        elif path.suffix in (".obj", ".txt"):
            path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert read_video(folder, use_cache=False).fingerprint == expected


def test_without_its_head_model_a_video_is_refused(copied):
    folder = copied("insta")
    (folder / HEAD_FILE).unlink()
    for head, message in (
        (None, r"generic_model\.pkl"),
        (toy_head(24), "vertices"),
        (toy_head(16, seed=5), "FLAME 2020"),
    ):
        with pytest.raises(InputError, match=message):
            read_video(folder, head=head)


IMAVATAR_FAULTS = {
    "positive focal length": (lambda document: document["intrinsics"].__setitem__(0, 3.0), "negative"),
    "pose of 12": (of_first("pose", [0.0] * 12), "15 numbers"),
    "no mask": (of_first("file_path", "./image/77"), "77.png"),
    "too many": (of_first("expression", [1.0] * 50), "at most 8"),
    "no intrinsics": (lambda document: document.pop("intrinsics"), "intrinsics"),
    "another identity": (lambda document: document["shape_params"].__setitem__(0, 9.0), "identity of"),
}


def changed(file, change):
    return lambda folder: edit_json(folder / file, change)


def replaced(file, content):
    return lambda folder: (
        (folder / file).unlink() if content is None else (folder / file).write_bytes(content)
    )


IMAVATAR = "MVI_1812/flame_params.json"
FAULTS = {
    **{
        f"{kind}, {name}": (kind, changed(file, change), message)
        for kind, file, faults in (
            ("insta, meshes", "transforms.json", INSTA_FAULTS),
            ("imavatar", IMAVATAR, IMAVATAR_FAULTS),
        )
        for name, (change, message) in faults.items()
    },
    **{name: ("insta", replaced(file, content), says) for name, (file, content, says) in FILE_FAULTS.items()},
    "splits that share frames": (
        "insta",
        lambda folder: shutil.copy(folder / "transforms.json", folder / "transforms_train.json"),
        "not trained on",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(copied, fault):
    kind, plant, message = FAULTS[fault]
    folder = copied(kind)
    plant(folder)
    with pytest.raises(InputError, match=message):
        read_video(folder, progress=no_progress)


def write_vhap(folder, count=10):
    """VHAP's monocular export: its split, its camera, stale intrinsics at the top, nothing of ours; the head beside it."""
    video = {"cameras": [replace(rig(cx=24.0, cy=32.0)[1], id="0")], "lengths": {"obama": count}}
    plan = make_plan(**video, test_sequences=(), novel_view_cameras=(), head=toy_head(16))
    written = write_tiny_capture(folder / "written", plan)
    export = folder / "obama_whiteBg_staticOffset_maskBelowLine"
    written.writer.sequence_folder("obama").rename(export)
    (export / "headbench.json").unlink()
    document = json.loads((export / "transforms.json").read_text())
    stale = {"fl_x": 512.0, "fl_y": 512.0, "cx": 512.0, "cy": 512.0, "camera_angle_x": 0.9}
    first = int(np.ceil(0.7 * count))
    parts = {"_train": range(first), "_val": range(0), "_test": range(first, count), "_backup": range(count)}
    for part, timesteps in {**parts, "": range(count)}.items():
        frames = [frame for frame in document["frames"] if frame["timestep_index"] in timesteps]
        text = json.dumps(document | stale | {"frames": frames, "timestep_indices": [*timesteps]})
        (export / f"transforms{part}.json").write_text(text)
    return export, plan


def test_vhaps_monocular_export_opens_with_the_reader_ga(tmp_path):
    export, plan = write_vhap(tmp_path)
    assert find_reader(export).name == "ga"
    save_head(tmp_path / "head.npz", plan.head)
    clip = open_clip(export, settings={"head": str(tmp_path / "head.npz")})
    assert (clip.subject, list(clip.cameras)) == ("obama", ["0"])
    assert [len(clip.splits[name]) for name in ("train", "novel_view", "self_reenactment")] == [7, 0, 3]
    np.testing.assert_allclose(clip.cameras["0"].K, plan.cameras[0].K, atol=1e-9)
    np.testing.assert_allclose(clip.poses[9].jaw, plan.sequences[0].poses[9].jaw)
    assert check_clip(clip) == []
    assert [*make_protocols(("novel_view", "self_reenactment"), [clip], None)] == ["self_reenactment"]
