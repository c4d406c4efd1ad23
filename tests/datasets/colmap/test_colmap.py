"""Models written are read back by pycolmap itself; models read are held against it; damage is refused."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from headbench.bench.conformance.command import check_clip
from headbench.bench.contracts import no_progress
from headbench.bench.errors import InputError
from headbench.datasets.colmap.command import ExportColmapSettings, export_colmap
from headbench.datasets.colmap.model import read_model
from headbench.datasets.colmap.reader import (
    export_model,
    export_tracking,
    image_name,
    model_cameras,
)
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.open import open_clip

from ..tiny_capture import projected

FILES = ("cameras", "images")


@pytest.fixture(scope="module")
def clip(pristine_capture):
    return read_capture(pristine_capture.union)


@pytest.fixture(scope="module")
def exported(clip, tmp_path_factory):
    """Both formats of all frames."""
    folders = {}
    for kind in ("bin", "txt"):
        folders[kind] = tmp_path_factory.mktemp(kind)
        export_model(clip, list(clip.files), folders[kind], model_format=kind)
    return folders


def theirs(folder):
    model = pycolmap.Reconstruction()
    model.read(folder / "sparse" / "0")
    return model


def random_model(rng, folder: Path, model_name="PINHOLE", params=(50.0, 51.0, 20.3, 14.7)):
    """Write a model of three images with points, by pycolmap, and return it."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=7, model=model_name, width=40, height=30, params=params)
    )
    for number in (3, 5, 9):
        quaternion = rng.normal(size=4)
        rotation = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
        image = pycolmap.Image(
            f"a b/{number}.png".replace(" ", ""), rng.uniform(0, 30, (number, 2)), 7, number
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, rng.normal(size=3)))
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
    model.write_text(folder)
    return model


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_cameras_are_read_back_exactly_and_by_pycolmap(clip, exported, kind):
    model, cameras = theirs(exported[kind]), model_cameras(read_model(exported[kind]))
    assert model.is_valid()
    assert (model.num_cameras(), model.num_images()) == (len(clip.cameras), len(clip.files))
    names = {image.name: image for image in model.images.values()}
    assert set(cameras) == set(names) == {image_name(key) for key in clip.files}
    vertices = np.array([model.points3D[number].xyz for number in sorted(model.points3D)])
    for key in clip.files:
        image, camera, found = names[image_name(key)], clip.cameras[key.camera], cameras[image_name(key)]
        assert (found.width, found.height) == (camera.width, camera.height)
        np.testing.assert_allclose(found.world_to_camera, camera.world_to_camera, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.K, camera.K, rtol=1e-14)
        np.testing.assert_allclose(image.cam_from_world().matrix(), camera.world_to_camera[:3], atol=1e-12)
        seen = np.array([image.project_point(vertex) for vertex in vertices])
        np.testing.assert_allclose(seen, projected(vertices, camera), atol=1e-9)


def test_points_are_the_mesh_and_observations_what_is_seen(clip, exported):
    model = theirs(exported["bin"])
    first = min(clip.poses)
    (mesh,) = PosedSubject(clip.head, clip.shape, clip.static_offset).meshes([clip.poses[first]])
    np.testing.assert_allclose(
        [model.points3D[number].xyz for number in sorted(model.points3D)], mesh, rtol=0, atol=1e-12
    )
    assert model.compute_mean_reprojection_error() < 1e-9
    at_first = {image_name(key): key for key in clip.files if key.timestep == first}
    for image in model.images.values():
        assert (image.num_points3D > 0) == (image.name in at_first)
        assert image.num_points3D < len(mesh)  # the back of a closed head is hidden
    for point in model.points3D.values():
        seen = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            column, row = np.floor(image.points2D[element.point2D_idx].xy).astype(int)
            seen.append(clip.image(at_first[image.name])[row, column])
        expected = np.mean(seen, axis=0) if seen else [128, 128, 128]
        assert np.abs(point.color.astype(float) - expected).max() <= 0.5


def test_pictures_and_masks_lie_where_colmap_looks(clip, exported):
    for key in clip.files:
        image = cv2.imread(str(exported["bin"] / "images" / image_name(key)))
        assert image is not None
        np.testing.assert_array_equal(image[..., ::-1], clip.image(key))
        mask = cv2.imread(str(exported["bin"] / "masks" / f"{image_name(key)}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask, clip.mask(key))


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_reader_equals_pycolmap_on_models_with_points(tmp_path, suffix):
    model = random_model(np.random.default_rng(0), tmp_path)
    for name in FILES:
        (tmp_path / f"{name}{'.txt' if suffix == '.bin' else '.bin'}").unlink()
    cameras = model_cameras(read_model(tmp_path))
    assert set(cameras) == {"ab/3.png", "ab/5.png", "ab/9.png"}
    for image in model.images.values():
        found = cameras[image.name]
        np.testing.assert_allclose(found.world_to_camera[:3], image.cam_from_world().matrix(), atol=1e-12)
        np.testing.assert_allclose(found.K, model.cameras[7].calibration_matrix(), rtol=1e-14)
        assert np.isclose(np.linalg.det(found.world_to_camera[:3, :3]), 1)


@pytest.mark.parametrize(
    ("model", "params"),
    [("SIMPLE_PINHOLE", [50.0, 20, 15]), ("OPENCV_FISHEYE", [50.0, 50, 20, 15, 0, 0, 0, 0])],
)
def test_intrinsics_are_those_without_distortion(tmp_path, model, params):
    random_model(np.random.default_rng(0), tmp_path, model, params)
    cameras = model_cameras(read_model(tmp_path))
    np.testing.assert_array_equal(cameras["ab/3.png"].K, [[50, 0, 20], [0, 50, 15], [0, 0, 1]])


def test_lenses_distort_as_pycolmap_does(tmp_path):
    params = [50.0, 52.0, 20.3, 14.7, 0.1, -0.02, 0.003, -0.002]
    model = random_model(np.random.default_rng(0), tmp_path, "OPENCV", params)
    lens = read_model(tmp_path).cameras[7]
    places = lens.map_from(lens.K, 40, 30)
    for column, row in [(0, 0), (12, 7), (39, 29)]:
        ray = np.linalg.solve(lens.K, [column + 0.5, row + 0.5, 1.0])
        np.testing.assert_allclose(places[row, column], model.cameras[7].img_from_cam(ray), atol=1e-4)
    random_model(np.random.default_rng(0), tmp_path, "FOV", [50.0, 50.0, 20.0, 15.0, 0.1])
    with pytest.raises(InputError, match="camera 7.*OPENCV.*FOV"):
        read_model(tmp_path)


@pytest.mark.parametrize("name", FILES)
def test_every_truncation_is_refused(tmp_path, name):
    random_model(np.random.default_rng(0), tmp_path)
    content = (tmp_path / f"{name}.bin").read_bytes()
    with pytest.raises(InputError, match="COLMAP model"):
        read_model(tmp_path / "none")
    for size in range(0, len(content), 5):
        (tmp_path / f"{name}.bin").write_bytes(content[:size])
        with pytest.raises(InputError, match=rf"{name}\.bin"):
            read_model(tmp_path)
    (tmp_path / f"{name}.bin").write_bytes(content + b"\0")
    with pytest.raises(InputError, match="1 more bytes"):
        read_model(tmp_path)


@pytest.mark.parametrize(
    ("find", "put", "found"),
    [
        *(("ab/3.png", "../3.png", "image 3, name"), ("ab/3.png", "/3.png", "image 3, name")),
        *(("ab/5.png", "ab/3.png", "again"), ("\n5 ", "\n3 ", "each image once")),
        *((" 7 ab/3.png", " 8 ab/3.png", "image 3, camera"), (" 7 ab/3.png", " 7", "ten words")),
        *(("\n3 ", "\n3 nan ", "ten words"), ("\n3 ", "\nx ", "ten words")),
    ],
)
def test_faults_in_a_text_model_are_named(tmp_path, find, put, found):
    random_model(np.random.default_rng(0), tmp_path)
    for name in FILES:
        (tmp_path / f"{name}.bin").unlink()
    text = (tmp_path / "images.txt").read_text()
    assert find in text
    (tmp_path / "images.txt").write_text(text.replace(find, put, 1))
    with pytest.raises(InputError, match=found):
        model_cameras(read_model(tmp_path))


@pytest.mark.parametrize(("first", "second"), [("bin", "txt"), ("txt", "bin")])
def test_another_format_replaces_the_model_that_was_there(clip, tmp_path, first, second):
    keys = sorted(clip.files)
    export_model(clip, keys[:3], tmp_path, model_format=first)
    export_model(clip, keys[-2:], tmp_path, model_format=second)
    assert set(read_model(tmp_path).images) == {1, 2}
    assert {image.name for image in theirs(tmp_path).images.values()} == {image_name(k) for k in keys[-2:]}
    assert {file.suffix for file in (tmp_path / "sparse" / "0").iterdir()} == {f".{second}"}


def test_what_the_model_cannot_hold_is_refused(clip, tmp_path):
    key = next(iter(clip.files))
    camera = clip.cameras[key.camera]
    skewed = {**clip.cameras, key.camera: replace(camera, K=camera.K + np.eye(3, k=1))}
    twin = key._replace(camera="a_00003_b")  # its flat name means another frame
    other = clip.derive("test", {}, cameras={twin.camera: camera}, files={twin: clip.files[key]})
    for chosen, keys, naming, message in (
        (clip.derive("test", {}, cameras=skewed), [key], "nested", "no skew"),
        (other, [twin], "flat", "--names nested"),
    ):
        with pytest.raises(InputError, match=message):
            export_model(chosen, keys, tmp_path / "o", naming=naming)
    assert not (tmp_path / "o").exists()


def test_command_writes_the_first_training_timestep(capture, tmp_path):
    out = tmp_path / "out"
    findings = export_colmap(ExportColmapSettings(str(capture.union), str(out)), no_progress)
    clip = read_capture(capture.union)
    first = clip.timesteps("train")[0]
    assert set(model_cameras(read_model(out))) == {
        image_name(key) for key in clip.files if key.timestep == first
    }
    assert findings.data["images"] == len(clip.cameras)
    with pytest.raises(InputError, match="--timesteps.*found 99"):
        export_colmap(ExportColmapSettings(str(capture.union), str(out), timesteps=(0, 99)), no_progress)


def with_tracking(clip, out, naming="nested"):
    """A COLMAP dataset of all frames, with tracking."""
    export_model(clip, list(clip.files), out, naming=naming)
    export_tracking(clip, set(clip.poses), out)
    return out


@pytest.fixture
def dataset(clip, tmp_path):
    return with_tracking(clip, tmp_path / "dataset")


def test_a_model_of_somebody_else_is_not_overwritten(capture, tmp_path):
    """A folder that the command wrote itself is continued."""
    mine, other = (
        ExportColmapSettings(str(capture.union), str(tmp_path / name)) for name in ("mine", "other")
    )
    assert export_colmap(mine, no_progress) == export_colmap(mine, no_progress)
    (tmp_path / "other" / "images").mkdir(parents=True)
    (tmp_path / "other" / "images" / "1.png").write_bytes(b"theirs")
    with pytest.raises(InputError, match="--out"):
        export_colmap(other, no_progress)


def test_flat_names_lie_where_other_readers_look(clip, tmp_path):
    out = with_tracking(clip, tmp_path / "flat", naming="flat")
    images = theirs(out).images.values()
    # 3D Gaussian splatting opens the base name, nerfbaselines takes the mask of the image's own stem.
    assert {image.name for image in images} == {path.name for path in (out / "images").iterdir()}
    for key in clip.files:
        name = image_name(key, "flat")
        for mask in (out / "masks" / name, out / "masks" / f"{name}.png"):
            np.testing.assert_array_equal(cv2.imread(str(mask), cv2.IMREAD_UNCHANGED), clip.mask(key))


@pytest.mark.parametrize("naming", ["nested", "flat"])
def test_an_exported_dataset_with_tracking_is_read_back(clip, tmp_path, naming):
    dataset = with_tracking(clip, tmp_path / "dataset", naming)
    found = open_clip(dataset, settings={"held_out_cameras": [next(iter(clip.splits["novel_view"])).camera]})
    assert found.subject == clip.subject
    assert set(found.files) == set(clip.files)
    assert found.excluded == clip.excluded
    assert check_clip(found) == []
    assert found.head.fingerprint() == clip.head.fingerprint()
    as_text = dataset.with_name("text")
    shutil.copytree(dataset, as_text)
    theirs(dataset).write_text(as_text / "sparse" / "0")
    for file in ("cameras.bin", "images.bin"):
        (as_text / "sparse" / "0" / file).unlink()
    assert open_clip(as_text).fingerprint == open_clip(dataset).fingerprint
    for timestep, pose in clip.poses.items():
        np.testing.assert_allclose(found.poses[timestep].expression, pose.expression, atol=1e-6)
    for key in clip.files:
        np.testing.assert_array_equal(found.image(key), clip.image(key))
        np.testing.assert_array_equal(found.mask(key), clip.mask(key))
        np.testing.assert_allclose(found.cameras[key.camera].K, clip.cameras[key.camera].K)


def renamed(dataset, name):
    """Give every image another name, in the model and on disk."""
    model = theirs(dataset)
    for image in model.images.values():
        new = name(image.name)
        for folder, suffix in (("images", ""), ("masks", ".png")):
            path = dataset / folder / f"{new}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            (dataset / folder / f"{image.name}{suffix}").rename(path)
        image.name = new
    model.write_binary(dataset / "sparse" / "0")


def test_images_named_as_vhap_does_are_read(clip, dataset):
    renamed(dataset, lambda name: "{2}_{3}".format(*name.split("/")))
    found = open_clip(dataset)
    assert {(key.timestep, key.camera) for key in found.files} == {
        (key.timestep, key.camera) for key in clip.files
    }


def turn_one_camera(dataset):
    model = theirs(dataset)
    frame = max(model.frames.values(), key=lambda frame: frame.frame_id)
    moved = frame.rig_from_world
    moved.translation = moved.translation + 0.01
    frame.rig_from_world = moved
    model.write_binary(dataset / "sparse" / "0")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: shutil.rmtree(d / "flame_param"), "no tracked head.*export colmap --tracking"),
        (lambda d: (d / "flame_param" / "00001.npz").unlink(), "00001.npz"),
        (lambda d: (d / "head_model.npz").unlink(), "head model the capture was tracked with"),
        (lambda d: renamed(d, lambda name: name.replace("/", "-")), "name timestep and camera"),
        (lambda d: shutil.rmtree(d / "images" / "901"), "no such file"),
        (turn_one_camera, "as in its other images"),
    ],
)
def test_faults_of_a_dataset_are_named(dataset, damage, message):
    damage(dataset)
    with pytest.raises(InputError, match=message):
        open_clip(dataset)


def test_sigterm_keeps_its_handler_with_pycolmap():
    code = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))\n"
        "from headbench.datasets.colmap.model import pycolmap\n"
        "pycolmap()\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (7, "")


@pytest.mark.parametrize(
    ("start", "end"), [("", "\n"), ("\ufeff", "\r\n"), (" # of another program\n\t", "\n")]
)
@pytest.mark.parametrize("name", ["a b/00001_x.png", "a\\b\\00001 x.PNG", "a  b.png"])
def test_names_and_line_ends_of_other_systems_are_read(tmp_path, start, end, name):
    camera = "1 PINHOLE 64 48 50 50 32 24"
    image = f"1 1 0 0 0 0 0 0 1 {name}"
    (tmp_path / "cameras.txt").write_bytes((start + camera + end).encode())
    (tmp_path / "images.txt").write_bytes((start + image + end + end).encode())
    assert read_model(tmp_path).images[1].name == name.replace("\\", "/")
