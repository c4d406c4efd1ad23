"""Finding participants, sequences, colour files and stills in every layout."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from headbench.bench.errors import InputError
from headbench.bench.io.files import write_json
from headbench.datasets.nersemble.recording import participant, participants, read_calibration

from .recordings import HEIGHT, SEQUENCES, SUBJECT, WIDTH, Recording, world_cameras, write_recording


def test_unmerged_parts_of_the_first_release_are_found(tmp_path):
    recording = write_recording(tmp_path, release="v1")
    for number, name in enumerate(SEQUENCES, start=1):
        part = recording.root / f"sequence_{name}_part-{number}" / SUBJECT
        part.mkdir(parents=True)
        (recording.root / SUBJECT / name).rename(part / name)
    (recording.root / SUBJECT).rmdir()
    assert sorted(participant(recording.root, SUBJECT).sequences) == sorted(SEQUENCES)


def with_colour(folder, release, matrices):
    """A recording without frames but with a colour calibration."""
    recording = Recording(folder, release)
    recording.write_calibration(world_cameras())
    recording.sequence_folder("FREE").mkdir(parents=True)
    if release == "v2":
        write_json(recording.calibration_file.with_name("color_calibration.json"), matrices)
        return recording
    old = f"{SUBJECT}/annotations/FREE/color_correction"
    folder = recording.root / (old if release == "paper2023" else f"color_correction/{SUBJECT}")
    folder.mkdir(parents=True)
    for serial, matrix in matrices.items():
        np.save(folder / f"{serial}.npy", matrix)
    return recording


@pytest.mark.parametrize("release", ["v2", "v1", "paper2023"])
def test_colour_files_are_found_where_each_release_has_them(release, tmp_path):
    cameras = world_cameras()
    matrix = np.eye(3, 4) + 0.1 if release != "v2" else np.eye(3, 10) + 0.1
    recording = with_colour(tmp_path, release, {camera.id: matrix for camera in cameras})
    corrections = participant(recording.root, SUBJECT).corrections("FREE", [cameras[0].id])
    np.testing.assert_allclose(corrections[cameras[0].id].matrix, matrix)


@pytest.mark.parametrize("release", ["v1", "v2"])
def test_a_colour_calibration_without_a_camera_is_an_error(release, tmp_path):
    cameras = world_cameras()
    recording = with_colour(tmp_path, release, {cameras[0].id: np.eye(3, 4)})
    with pytest.raises(InputError, match=cameras[1].id):
        participant(recording.root, SUBJECT).corrections("FREE", [c.id for c in cameras])


def test_without_colour_files_there_is_no_correction(pristine_recording):
    assert participant(pristine_recording.root, SUBJECT).corrections("FREE", ["222200037"]) == {}


def test_stills_are_no_sequence(recording):
    recording.write_background("222200037", np.zeros((4, 4, 3), np.uint8))
    one = participant(recording.root, SUBJECT)
    assert "BACKGROUND" not in one.sequences
    assert [*one.backgrounds] == ["222200037"]


def test_the_metadata_says_what_to_fetch(recording):
    recording.write_metadata([*SEQUENCES, "HAIR"])
    one = participant(recording.root, SUBJECT)
    assert one.match("EMO-1") == "EMO-1-shout+laugh"
    for name, listed in (("HAIR", True), ("GLASSES", False)):
        with pytest.raises(InputError) as error:
            one.match(name)
        assert (f"metadata_sequences.csv lists {name}" in str(error.value)) == listed


def test_other_folders_and_missing_files_are_refused(recording, tmp_path):
    (tmp_path / "other" / "images").mkdir(parents=True)
    for name in ("nowhere", "other"):
        with pytest.raises(InputError, match=name):
            participants(tmp_path / name)
    with pytest.raises(InputError, match="subject.*902"):
        participant(recording.root, "902")
    recording.calibration_file.unlink()
    with pytest.raises(InputError, match="camera_params.json"):
        participant(recording.root, SUBJECT)


def write(path, **changes):
    cameras = world_cameras()
    value = {
        "world_2_cam": {c.id: c.world_to_camera.tolist() for c in cameras},
        "intrinsics": cameras[0].K.tolist(),
        "height": HEIGHT,
        "width": WIDTH,
    }
    path.write_text(json.dumps({key: entry for key, entry in (value | changes).items() if entry is not None}))
    return path


@pytest.fixture
def file(tmp_path):
    return tmp_path / "camera_params.json"


def test_the_aligned_world_is_that_of_vhap(file):
    aligned = read_calibration(write(file)).aligned()
    to_world = [np.linalg.inv(matrix) for matrix in aligned.world_to_camera.values()]
    # The mean camera, orthonormalised (here by QR, which is Gram-Schmidt up to signs), has OpenGL's axes.
    q, r = np.linalg.qr(np.mean([matrix[:3, :3] for matrix in to_world], axis=0))
    mean = q * np.sign(np.diag(r))
    np.testing.assert_allclose(mean, np.diag([1.0, -1.0, -1.0]), atol=1e-9)
    for matrix in to_world:
        assert matrix[2, 3] > 0.5, "cameras stand on the side that the face looks to"
        assert matrix[1, 1] < -0.8, "image down is world down"


def test_alignment_is_a_rotation_about_the_origin(file):
    calibration = read_calibration(write(file))
    aligned = calibration.aligned()
    motions = [
        np.linalg.inv(aligned.world_to_camera[s]) @ calibration.world_to_camera[s] for s in aligned.serials
    ]
    for motion in motions:
        np.testing.assert_allclose(motion, motions[0], atol=1e-12)
        np.testing.assert_allclose(motion[:3, 3], 0, atol=1e-12)
        np.testing.assert_allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3), atol=1e-12)


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_the_recordings_own_world_does_not_matter(tmp_path_factory, axis_angle):
    file = tmp_path_factory.mktemp("calibration") / "camera_params.json"
    first = read_calibration(write(file)).aligned()
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(axis_angle).as_matrix()
    turned = {c.id: (c.world_to_camera @ turn).tolist() for c in world_cameras()}
    again = read_calibration(write(file, world_2_cam=turned)).aligned()
    for serial in first.serials:
        np.testing.assert_allclose(again.world_to_camera[serial], first.world_to_camera[serial], atol=1e-9)


def test_intrinsics_scale_with_the_edges_of_the_image(file):
    calibration = read_calibration(write(file))
    camera = calibration.camera(calibration.serials[1], (WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2))
    original = world_cameras()[1]
    point = np.array([0.03, -0.02, 0.05, 1.0])
    full = original.K @ (original.world_to_camera @ point)[:3]
    half = camera.K @ (camera.world_to_camera @ point)[:3]
    np.testing.assert_allclose(half[:2] / half[2], full[:2] / full[2] / 2, atol=1e-12)


def test_per_camera_intrinsics_mean_the_images_as_they_are(file):
    own = {c.id: (c.K * [[k + 1], [1], [1]]).tolist() for k, c in enumerate(world_cameras())}
    calibration = read_calibration(write(file, intrinsics=own, width=None, height=None))
    assert calibration.size is None
    for serial, matrix in own.items():
        np.testing.assert_array_equal(calibration.camera(serial, (32, 40), (32, 40)).K, matrix)


def test_the_size_may_be_stated_as_floats(file):
    """As scripts write it that take it from a video's properties."""
    assert read_calibration(write(file, width=float(WIDTH), height=float(HEIGHT))).size == (WIDTH, HEIGHT)


def test_other_shapes_and_opposite_cameras_are_refused(file):
    calibration = read_calibration(write(file))
    with pytest.raises(InputError, match="64x48"):
        calibration.camera(calibration.serials[0], (HEIGHT, WIDTH), (24, 32))
    opposite = {"1": np.eye(4).tolist(), "2": np.diag([-1.0, 1, -1, 1]).tolist()}
    with pytest.raises(InputError, match="world_2_cam"):
        read_calibration(write(file, world_2_cam=opposite)).aligned()


MATRIX = np.eye(4).tolist()
K = [[100.0, 0, 24], [0, 100, 32], [0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"world_2_cam": {}}, "world_2_cam"),
        ({"world_2_cam": [MATRIX]}, "world_2_cam"),
        ({"world_2_cam": {"1": [[1, 0], [0, 1]]}}, "world_2_cam.1"),
        ({"world_2_cam": {"1": (2 * np.eye(4)).tolist()}}, "world_2_cam.1"),
        ({"world_2_cam": {"1": np.diag([1.0, 1, -1, 1]).tolist()}}, "world_2_cam.1"),
        ({"world_2_cam": {"../1": MATRIX}}, "world_2_cam"),
        ({"world_2_cam": {"1": "eye"}}, "world_2_cam.1"),
        ({"intrinsics": None}, "intrinsics"),
        ({"intrinsics": (-np.array(K)).tolist()}, "intrinsics"),
        ({"intrinsics": [[100.0, 5, 24], *K[1:]]}, "intrinsics"),
        ({"intrinsics": [[float("nan"), 0, 24], *K[1:]]}, "intrinsics[0][0]"),
        ({"intrinsics": {"222200042": K}}, "intrinsics"),
        ({"height": 0}, "height"),
        ({"width": None}, "width"),
        ({"width": True}, "width"),
        ({"width": 1.5}, "width"),
        ({"width": 10**400}, "width"),
    ],
)
def test_a_faulty_calibration_names_the_entry(change, key, file):
    with pytest.raises(InputError) as error:
        read_calibration(write(file, **change))
    assert (error.value.file, error.value.key) == (str(file), key)
