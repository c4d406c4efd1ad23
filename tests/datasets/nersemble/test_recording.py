"""Finding participants, sequences, colour files and stills in every layout."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from headbench.bench.errors import InputError
from headbench.bench.io.files import write_json
from headbench.datasets.images import srgb_to_linear
from headbench.datasets.nersemble.recording import (
    POLYNOMIALS,
    AffineCorrection,
    PolynomialCorrection,
    affine_correction,
    linear_to_srgb,
    participant,
    participants,
    polynomial_correction,
    prepare_pixels,
    read_calibration,
)

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


def test_only_cameras_that_are_used_need_intrinsics(file):
    calibration = read_calibration(write(file, intrinsics={"222200042": K}, width=None, height=None))
    assert calibration.camera("222200042", (48, 64), (48, 64)).K.tolist() == K
    with pytest.raises(InputError, match="intrinsics: expected a matrix for camera 222200037, found none"):
        calibration.camera("222200037", (48, 64), (48, 64))


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


FRAMES = arrays(np.uint8, (8, 12, 3))


def area_mean(image: np.ndarray, factor: int) -> np.ndarray:
    height, width = image.shape[:2]
    blocks = image.reshape(height // factor, factor, width // factor, factor, -1)
    return blocks.astype(np.float64).mean(axis=(1, 3))


@pytest.mark.parametrize("factor", [1, 2, 4])
@settings(max_examples=25)
@given(frame=FRAMES)
def test_without_a_mask_pixels_are_area_means(factor, frame):
    image, mask = prepare_pixels(frame, None, (12 // factor, 8 // factor))
    assert mask is None
    assert np.abs(image - area_mean(frame[..., ::-1], factor)).max() <= 0.5


@settings(max_examples=25)
@given(frame=FRAMES, mask=arrays(np.uint8, (8, 12)))
def test_with_a_mask_the_weighted_foreground_stands_on_white(frame, mask):
    coverage = mask[..., None] / 255
    expected = area_mean(frame[..., ::-1] * coverage + 255 * (1 - coverage), 4)
    image, reduced = prepare_pixels(frame, mask, (3, 2))
    # Products, means and the composite are rounded to 8 bits, one after the other.
    assert np.abs(image - expected).max() <= 2
    assert np.abs(reduced - area_mean(mask, 4)[..., 0]).max() <= 0.5


def test_full_and_empty_masks_are_exact():
    frame = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    full, _ = prepare_pixels(frame, np.full((8, 12), 255, np.uint8), (12, 8))
    np.testing.assert_array_equal(full, frame[..., ::-1])
    for still in (None, 255 - frame):
        empty, _ = prepare_pixels(frame, np.zeros((8, 12), np.uint8), (12, 8), None, still)
        np.testing.assert_array_equal(empty, 255)


@settings(max_examples=25)
@given(foreground=FRAMES, wall=FRAMES, mask=arrays(np.uint8, (8, 12)))
def test_the_still_takes_the_wall_out_of_soft_edges(foreground, wall, mask):
    coverage = mask[..., None] / 255
    frame = np.rint(foreground * coverage + wall * (1 - coverage)).astype(np.uint8)
    wanted = (foreground * coverage + 255 * (1 - coverage))[..., ::-1]
    image, _ = prepare_pixels(frame, mask, (12, 8), None, wall)
    assert np.abs(image - wanted).max() <= 2


def test_nothing_outside_the_mask_is_averaged_in():
    frame = np.full((2, 2, 3), 255, np.uint8)
    frame[0, 0] = 0
    mask = np.zeros((2, 2), np.uint8)
    mask[0, 0] = 255
    for still in (None, np.zeros((2, 2, 3), np.uint8)):
        image, _ = prepare_pixels(frame, mask, (1, 1), None, still)
        np.testing.assert_allclose(image, 191, atol=1)


def test_colours_are_corrected_before_the_composite():
    # Doubles the red of the foreground and lifts green; white stays white.
    correction = AffineCorrection(np.array([[2.0, 0, 0, 0], [0, 1, 0, 0.2], [0, 0, 1, 0]]))
    frame = np.full((4, 4, 3), (30, 40, 50), np.uint8)  # BGR
    mask = np.zeros((4, 4), np.uint8)
    mask[:, :2] = 255
    image, reduced = prepare_pixels(frame, mask, (2, 2), correction)
    np.testing.assert_array_equal(image[0], [[100, 91, 30], [255, 255, 255]])
    np.testing.assert_array_equal(reduced[0], [255, 0])
    plain, _ = prepare_pixels(frame, None, (2, 2), correction)
    np.testing.assert_array_equal(plain[0, 0], [100, 91, 30])


# sum over i of (i + 1) * term i of colour-science 0.4.7's matrix_augmented_Cheung2004 at RGB (0.7, 0.3, 0.11).
WEIGHTED_SUMS = {
    3: 1.63,
    4: 5.63,
    5: 6.7224,
    7: 10.053,
    8: 11.2147,
    10: 17.3119,
    11: 18.5429,
    14: 25.657203,
    16: 14.617106,
    17: 31.617106,
    19: 17.488779,
    20: 37.488779,
    22: 18.013611,
    35: 65.98024724,
}

IMAGES = arrays(np.uint8, (3, 5, 3))
ALL_LEVELS = np.stack([np.arange(256)] * 3, axis=-1).astype(np.uint8)[None]


@pytest.mark.parametrize("count", WEIGHTED_SUMS)
def test_terms_are_those_of_colour_science(count):
    channels = dict(zip("rgb", (0.7, 0.3, 0.11)))
    terms = [np.prod([channels[c] for c in term]) for term in POLYNOMIALS[count]]
    assert len(terms) == count
    assert POLYNOMIALS.keys() == WEIGHTED_SUMS.keys()
    assert np.dot(terms, np.arange(1, count + 1)) == pytest.approx(WEIGHTED_SUMS[count], abs=1e-9)


def test_the_curve_is_that_of_srgb():
    # colour-science 0.4.7: cctf_decoding and cctf_encoding.
    np.testing.assert_allclose(
        srgb_to_linear(np.array([0.5, 0.03])), [0.214041140482, 0.00232198142415], rtol=1e-10
    )
    encoded = linear_to_srgb(np.full((1, 1, 3), 0.2))
    np.testing.assert_allclose(encoded, 0.484529204482, rtol=1e-6)


def reference(matrix: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Version 2 in float64, pixel by pixel."""
    terms = POLYNOMIALS[matrix.shape[1]]
    out = np.empty(image.shape)
    for where in np.ndindex(image.shape[:2]):
        value = image[where] / 255
        linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
        expanded = [np.prod([dict(zip("rgb", linear))[c] for c in term]) for term in terms]
        mapped = np.clip(matrix @ np.array(expanded), 0, 1)
        out[where] = np.where(mapped <= 0.0031308, 12.92 * mapped, 1.055 * mapped ** (1 / 2.4) - 0.055)
    return 255 * out


@pytest.mark.parametrize("count", POLYNOMIALS)
@settings(max_examples=5)
@given(image=IMAGES, seed=st.integers(0, 100))
def test_polynomials_agree_with_float64(count, image, seed):
    rng = np.random.default_rng(seed)
    matrix = np.eye(3, count) + 0.15 * rng.normal(size=(3, count))
    result = PolynomialCorrection(matrix)(image)
    assert result.dtype == np.uint8
    assert np.abs(result - reference(matrix, image)).max() <= 0.53


@settings(max_examples=20)
@given(image=IMAGES, values=arrays(np.float64, (4, 4), elements=st.floats(-2, 2)))
def test_affine_maps_multiply_rows_from_the_left(image, values):
    expected = 255 * np.clip(image / 255 @ values[:3, :3] + values[:3, 3], 0, 1)
    result = AffineCorrection(values[:3])(image)
    assert np.abs(result - expected).max() <= 0.501


@pytest.mark.parametrize("count", POLYNOMIALS)
def test_the_identity_changes_no_level(count):
    kinds = [(PolynomialCorrection, np.eye(3, count)), (AffineCorrection, np.eye(3, 4))]
    for kind, identity in kinds:
        for nearly in (identity, identity + 1e-9):  # of the second the whole computation runs
            np.testing.assert_array_equal(kind(nearly)(ALL_LEVELS), ALL_LEVELS)


@pytest.mark.parametrize(
    "content",
    [
        *(np.eye(2), np.zeros((3, 3)), np.full((4, 4), np.nan), np.full((4, 4), "a")),
        *(np.array([{"a": 1}], dtype=object), np.zeros((4, 4), complex)),
        *(b"", b"\x93NUMPY\x01\x00", b"PK\x03\x04", None),
    ],
)
def test_faulty_affine_files_are_refused(content, tmp_path):
    path = tmp_path / "1.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        np.save(path, content, allow_pickle=True)
    with pytest.raises(InputError) as error:
        affine_correction(path)
    assert error.value.file == str(path)


@pytest.mark.parametrize(
    "value",
    [
        *(None, 1, "M", [[1, 2, 3]], [[1, 2], [3]], [[[1]]]),
        *(np.eye(3, 6).tolist(), np.full((3, 3), np.inf).tolist()),
    ],
)
def test_faulty_polynomials_are_refused(value, tmp_path):
    with pytest.raises(InputError) as error:
        polynomial_correction(tmp_path / "color_calibration.json", "222200037", value)
    assert error.value.key == "222200037"
