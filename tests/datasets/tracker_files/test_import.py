"""``headbench import tracking``: captures of trackers' files show what their own programs project."""

import json
import os
import shutil

import cv2
import numpy as np
import pytest
import torch

from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import save_head
from headbench.datasets.images import read_image
from headbench.datasets.tracker_files.command import ImportTrackingSettings, import_tracking
from headbench.datasets.tracker_files.formats import FORMATS

from ..head.toy import toy_head
from ..monocular.videos import recording_of
from ..tiny_capture import in_camera, rig
from .trackers import (
    HEAD_FILE,
    rest_mesh,
    save,
    seen_by_nvdiffrast,
    seen_by_pytorch3d,
    subject_of,
    upper,
    write_flashavatar,
    write_metrical,
    write_pixel3dmm,
)

KINDS = ["metrical", "eyelids", "flashavatar", "pixel3dmm"]
FRAMES, SIZE, TRACKED = 8, 96, 48
LENGTHS = {"FREE": FRAMES - 2, "SEN-01-port": 2}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    def made(eyelids=False, **settings):
        head = toy_head(16, eyelids=eyelids)
        return recording_of(tmp_path_factory.mktemp("capture"), LENGTHS, head=head, **settings)

    plain = made()
    square = rig(SIZE, SIZE, 0.45 * SIZE, 0.53 * SIZE)[:2]
    return {
        "metrical": plain,
        "flashavatar": plain,
        "eyelids": made(eyelids=True),
        "pixel3dmm": made(neck=True, cameras=square),
    }


@pytest.fixture(scope="module")
def written(recordings, tmp_path_factory):
    root = tmp_path_factory.mktemp("trackers")
    return {
        "metrical": write_metrical(recordings["metrical"], root / "metrical"),
        "eyelids": write_metrical(recordings["eyelids"], root / "my_eyelids"),
        "flashavatar": write_flashavatar(recordings["flashavatar"], root / "flashavatar"),
        "pixel3dmm": write_pixel3dmm(recordings["pixel3dmm"], root / "pixel3dmm", tracked=TRACKED),
    }


def imported(source, out, **settings):
    head = settings.pop("head", str(source / HEAD_FILE))
    settings = {"cut": "none", **settings}  # so that images are those of the video
    return import_tracking(ImportTrackingSettings(str(source), head, str(out), **settings))


@pytest.fixture(scope="module")
def results(written, tmp_path_factory):
    outs = {kind: tmp_path_factory.mktemp(kind) / "out" for kind in KINDS}
    return {kind: (outs[kind], imported(written[kind], outs[kind])) for kind in KINDS}


@pytest.fixture
def copied(written, tmp_path):
    """Copy a tracker's output, which a test may damage."""

    def copy(kind):
        source = written[kind]
        below = source.parent if kind == "pixel3dmm" else source
        shutil.copytree(below, tmp_path / "copied")
        return tmp_path / "copied" / source.relative_to(below)

    return copy


def frame(source, number=0):
    return torch.load(source / f"checkpoint/{number:05d}.frame", weights_only=False)


@pytest.mark.parametrize("kind", KINDS)
def test_the_capture_projects_as_the_trackers_program(recordings, written, results, kind):
    recording, clip = recordings[kind], read_capture(results[kind][1].data["capture"])
    (camera,) = clip.cameras.values()
    assert (camera.width, camera.height) == (recording.camera.width, recording.camera.height)
    meshes = subject_of(clip).meshes([clip.poses[timestep] for timestep in range(FRAMES)])
    vertices = len(recording.head.template)
    for number, (key, mesh) in enumerate(zip(recording.keys, meshes)):
        content, rest = frame(written[kind], number), rest_mesh(recording, key)
        if kind == "pixel3dmm":
            points, pixels = seen_by_nvdiffrast(content, rest, SIZE)
        else:
            points, pixels = seen_by_pytorch3d(content, rest)
        found = in_camera(mesh[:vertices], camera)
        np.testing.assert_allclose(found, points, rtol=0, atol=1e-7)  # 1e-4 mm
        projected = found @ camera.K.T
        np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], pixels, rtol=0, atol=1e-3)
        # The same as the camera and the head that the tracker saw.
        truth = subject_of(recording.clip).meshes([recording.pose(key)])[0][:vertices]
        np.testing.assert_allclose(found, in_camera(truth, recording.camera), rtol=0, atol=5e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_images_and_masks_are_those_of_the_video(recordings, results, kind):
    recording, clip = recordings[kind], read_capture(results[kind][1].data["capture"])
    keys = sorted((key for part in clip.splits.values() for key in part), key=lambda key: key.timestep)
    for key, source in zip(keys, recording.keys, strict=True):
        truth, mask = recording.clip.image(source).astype(int), recording.clip.mask(source).astype(int)
        if kind == "flashavatar":
            mask = mask * (upper(*mask.shape) > 0)
            truth = np.where(upper(*mask.shape)[..., None] > 0, truth, 255)
        allowed = 4 if kind == "flashavatar" else 1  # its images and mattes are JPEG
        assert np.abs(clip.mask(key).astype(int) - mask).max() <= allowed
        assert np.abs(clip.image(key).astype(int) - truth).max() <= 2 * allowed


def test_the_last_frames_are_held_out(results):
    for _, result in results.values():
        clip = read_capture(result.data["capture"])
        assert clip.timesteps("self_reenactment") == [FRAMES - 2, FRAMES - 1]
        assert clip.timesteps("train") == [*range(FRAMES - 2)]
        assert not clip.splits["novel_view"]
        assert "a quarter: fewer than the 350" in result.text


def test_what_is_written_and_said(results, written):
    out, result = results["metrical"]
    assert json.loads((out / "import.json").read_text()) == result.data
    assert result.data["left_out"]["eyelids"].startswith("up to 0.50 (1 closes an eye), above 0.05 in 8 of 8")
    assert "l_eyelid.npy" in result.text
    assert read_image(out / "overlay.png", (1, 1, 1)).shape == (6 * 64, 2 * 48, 3)
    clip = read_capture(result.data["capture"])
    image = next(iter(clip.files.values())).image
    assert any(os.path.samefile(image, file) for file in (written["metrical"] / "input").iterdir())
    assert results["flashavatar"][1].data["masks"] == "alpha times parsing"
    assert results["pixel3dmm"][1].data["masks"] == "seg_og"
    assert results["eyelids"][1].data["left_out"] == {}
    assert read_capture(results["eyelids"][1].data["capture"]).subject == "my-eyelids"


def test_a_turned_neck_moves_lids_otherwise(tmp_path):
    recording = recording_of(
        tmp_path / "c", LENGTHS, neck=True, cameras=rig(SIZE, SIZE)[:2], head=toy_head(16, eyelids=True)
    )
    source = write_pixel3dmm(recording, tmp_path / "p", tracked=TRACKED)
    assert "lids turn with the neck here: up to 0." in imported(source, tmp_path / "out").text


def test_images_without_masks_are_imported_with_a_warning(copied, tmp_path):
    source = copied("flashavatar")
    for name in ("alpha", "parsing"):
        shutil.rmtree(source / name)
    result = imported(source, tmp_path / "out", held_out_frames=3, subject="me")
    assert "masks     none" in result.text
    clip = read_capture(result.data["capture"])
    assert clip.subject == "me"
    assert len(clip.splits["self_reenactment"]) == 3
    assert not any(clip.has_mask(key) for key in clip.files)


def test_coefficients_fit_the_bases_of_the_head(recordings, copied, tmp_path):
    source = copied("metrical")
    save_head(tmp_path / "large.npz", toy_head(16, shape_size=310, expression_size=120))
    large = read_capture(imported(source, tmp_path / "a", head=str(tmp_path / "large.npz")).data["capture"])
    assert large.shape.shape == (310,)
    np.testing.assert_array_equal(large.shape[:6], recordings["metrical"].clip.shape)
    assert not large.shape[6:].any()
    save_head(tmp_path / "small.npz", toy_head(16, expression_size=3))
    with pytest.raises(InputError, match="at most 3 coefficients"):
        imported(source, tmp_path / "b", head=str(tmp_path / "small.npz"))
    assert not (tmp_path / "b").exists()


class Code:
    """A pickle that would run something."""

    def __reduce__(self):
        return os.mkdir, ("ran",)


def test_the_torso_is_cut_unless_it_is_to_stay(results, written, tmp_path):
    whole = results["metrical"][1].data
    cut = imported(written["metrical"], tmp_path / "out", cut="bust-line").data
    assert (whole["cut"], cut["cut"]) == ("", "bust-line")
    clips = [read_capture(data["capture"]) for data in (whole, cut)]
    assert [clip.steps[0].parameters.get("cut") for clip in clips] == [None, "bust-line"]
    rows: list[int] = []
    for key in clips[0].files:
        before, after = (clip.mask(key).astype(int) for clip in clips)
        assert (after <= before).all()
        lost = np.flatnonzero((after < before).any(axis=1))
        rows += lost.tolist()
        assert (lost > np.flatnonzero(before.any(axis=1)).mean()).all()  # below the middle of the head
    assert rows


def edited(change, number=1):
    def edit(source):
        path = source / f"checkpoint/{number:05d}.frame"
        content = frame(source, number)
        change(content)
        save(path, content)

    return edit


def put(group, name, value):
    return edited(lambda content: content[group].__setitem__(name, value))


def images(change):
    def edit(source):
        for path in sorted((source / "input").iterdir()):
            change(path)

    return edit


def truncated(source):
    path = source / "checkpoint/00002.frame"
    path.write_bytes(path.read_bytes()[:-300])


def small(path):
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2])


def renamed(old, new):
    return lambda source: (source / "checkpoint" / old).rename(source / "checkpoint" / new)


FAULTS = {
    "code": (edited(lambda content: content.update(frame_id=Code())), "global posix.mkdir", "could run code"),
    "truncated": (truncated, "00002.frame"),
    "no pickle": (lambda source: (source / "checkpoint/00001.frame").write_text("no"), "00001.frame"),
    "a tensor": (put("flame", "exp", torch.zeros(1, 100)), "torch._utils"),
    "a missing array": (edited(lambda content: content["opencv"].pop("K")), "opencv.K"),
    "a missing group": (edited(lambda content: content.pop("flame")), "flame.shape"),
    "a wrong shape": (put("flame", "jaw", np.zeros((1, 3), np.float32)), "flame.jaw", "shape (1, 6)"),
    "integers": (put("flame", "exp", np.zeros((1, 100), int)), "flame.exp", "floating-point"),
    "a number that is none": (put("flame", "exp", np.full((1, 100), np.nan)), "flame.exp", "finite"),
    "another expression basis": (put("flame", "exp", np.zeros((1, 50))), "flame.exp", "(1, 100)"),
    "another identity": (put("flame", "shape", np.ones((1, 300))), "flame.shape", "the identity of 00000"),
    "no rotation": (put("flame", "jaw", np.zeros((1, 6))), "flame.jaw", "6D rotations"),
    "no rigid camera": (put("opencv", "R", np.ones((1, 3, 3))), "opencv.R", "rigid"),
    "another focal length": (put("opencv", "K", 50 * np.eye(3)[None]), "00001.frame", "intrinsics of"),
    "another tracked size": (edited(lambda content: content.update(img_size=np.array([64, 64]))), "img_size"),
    "images of another size": (images(small), "00000.png", "48x64 pixels, the size that 00000.frame"),
    "a frame without an image": (lambda s: (s / "input/00003.png").unlink(), "input", "none for 1 of 8"),
    "no images": (lambda source: shutil.rmtree(source / "input"), "--images"),
    "no frames": (lambda source: shutil.rmtree(source / "checkpoint"), "no checkpoint/"),
    "a name without a number": (renamed("00001.frame", "last.frame"), "last.frame", "number"),
    "a frame twice": (lambda s: shutil.copy(s / "checkpoint/00001.frame", s / "checkpoint/1.frame"), "once"),
    "a damaged image": (lambda source: (source / "input/00004.png").write_bytes(b"no"), "00004.png"),
    "flashavatar: a missing mask": (lambda s: (s / "alpha/00002.jpg").unlink(), "a mask for each image"),
    "flashavatar: no second mask": (lambda s: (s / "parsing/00002_neckhead.png").unlink(), "a mask for each"),
    "flashavatar: a mask of another size": (lambda s: small(s / "alpha/00002.jpg"), "as its image"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named_before_anything_is_written(copied, tmp_path, monkeypatch, fault):
    monkeypatch.chdir(tmp_path)
    plant, *names = FAULTS[fault]
    source = copied("flashavatar" if "flashavatar" in fault else "metrical")
    plant(source)
    with pytest.raises(InputError) as caught:
        imported(source, tmp_path / "out")
    assert all(name in f"{caught.value} {caught.value.remedy}" for name in names), caught.value
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "ran").exists()


def test_faults_of_pixel3dmm_are_named(copied, tmp_path):
    source = copied("pixel3dmm")
    edited(lambda content: content["camera"].update(R_base_1=np.eye(3)[None]))(source)
    with pytest.raises(InputError, match="several"):
        imported(source, tmp_path / "out")
    edited(lambda content: content.update(img_size=np.array([48, 64])), 0)(source)
    with pytest.raises(InputError, match="a square image"):
        imported(source, tmp_path / "out")
    for path in source.parent.glob("[cs]*/*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path))[:60])
    shutil.copy(source / "checkpoint/00002.frame", source / "checkpoint/00000.frame")
    shutil.copy(source / "checkpoint/00002.frame", source / "checkpoint/00001.frame")
    with pytest.raises(InputError, match="48x48 pixels, the size that"):
        imported(source, tmp_path / "out")


def test_formats_are_chosen_and_recognised(copied, tmp_path):
    source = copied("metrical")
    for folder, name, message in (
        (source / "input", "metrical", "no checkpoint/"),
        (source, "vhap", ", ".join(FORMATS)),
        (source, "pixel3dmm", "an array of that name"),
    ):
        with pytest.raises(InputError, match=message):
            imported(folder, tmp_path / "out", format=name, head=str(source / HEAD_FILE))
    edited(lambda content: content.pop("opencv"), 0)(source)
    with pytest.raises(InputError, match="--format"):
        imported(source, tmp_path / "out")
