"""Statistics against scipy's rotations and an explicit PCA over vertices."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from skimage.transform import downscale_local_mean

from headbench.datasets.inspect.statistics import expression_space, novelty, sequence_rows, split_rows
from headbench.datasets.steps.exclude import exclude_timesteps
from headbench.datasets.steps.for_method import resize_image

from ..lint.good_capture import LENGTHS


@pytest.fixture(scope="module")
def space(clip):
    return expression_space(clip)


def face_displacements(clip, timesteps):
    """(T, F, 3) millimetres that the face moves by expression."""
    face = clip.head.regions["face"]
    basis = clip.head.expression_basis[face]
    return 1000 * np.stack([basis @ clip.poses[t].expression for t in timesteps]).astype(np.float64)


def test_split_rows_count_what_the_splits_hold(clip):
    rows = {row.split: row for row in split_rows(clip)}
    assert set(rows) == {"train", "novel_view", "self_reenactment"}
    train = rows["train"]
    assert (train.images, train.timesteps, train.cameras, train.sequences) == (36, 12, 3, 2)
    assert (rows["novel_view"].images, rows["novel_view"].cameras) == (12, 1)
    assert (rows["self_reenactment"].images, rows["self_reenactment"].cameras) == (40, 4)


def test_excluded_timesteps_are_counted_and_left_out(clip):
    without = exclude_timesteps(clip, {12: "tongue out"})
    assert [row.images for row in split_rows(without) if row.split == "excluded"] == [4]
    row = next(row for row in sequence_rows(without) if row.sequence == "FREE")
    assert (row.timesteps, row.excluded) == (LENGTHS["FREE"] - 1, 1)
    assert 12 not in expression_space(without).timesteps


def test_sequence_rows_agree_with_scipy(clip):
    rows = sequence_rows(clip)
    assert [row.sequence for row in rows] == list(LENGTHS)
    assert [row.held_out for row in rows] == [False, False, True]
    timesteps = sorted({k.timestep for k in clip.splits["self_reenactment"]})
    poses = [clip.poses[t] for t in timesteps]
    turns = Rotation.from_rotvec([p.rotation for p in poses]) * Rotation.from_rotvec([p.neck for p in poses])
    away = np.degrees((turns.mean().inv() * turns).magnitude()).max()
    free = rows[-1]
    assert free.head_deg == pytest.approx(away, rel=1e-3)
    jaw = np.degrees(Rotation.from_rotvec([p.jaw for p in poses]).magnitude())
    assert free.jaw_deg == pytest.approx((jaw.min(), np.median(jaw), jaw.max()), rel=1e-5)
    places = np.stack([p.translation for p in poses])
    assert free.head_mm == pytest.approx(
        1000 * np.linalg.norm(places - places.mean(0), axis=1).max(), rel=1e-4
    )
    everywhere = np.stack([clip.head.expression_basis @ p.expression for p in poses])
    reach = 1000 * np.linalg.norm(everywhere, axis=2).max(axis=1)
    assert free.reach_mm == pytest.approx((np.median(reach), reach.max()), rel=1e-5)


def test_the_space_of_expressions_is_the_pca_of_the_faces(clip, space):
    faces = face_displacements(clip, space.timesteps)
    count = faces.shape[1]
    flat = faces.reshape(len(faces), -1)
    train = flat[~space.held_out]
    _, singular, axes = np.linalg.svd(train - train.mean(axis=0), full_matrices=False)
    explained = singular**2 / (singular**2).sum()
    kept = min(len(explained), len(space.explained), 6)
    assert space.explained[:kept] == pytest.approx(explained[:kept], abs=1e-8)
    scores = (flat - train.mean(axis=0)) @ axes.T / np.sqrt(count)
    for component in range(3):
        ours, theirs = space.scores_mm[:, component], scores[:, component]
        assert min(np.abs(ours - theirs).max(), np.abs(ours + theirs).max()) < 1e-6
    assert np.cumsum(space.explained)[space.kept - 1] >= 0.95
    assert space.kept == 1 or np.cumsum(space.explained)[space.kept - 2] < 0.95


def test_novelty_is_the_distance_to_the_nearest_training_face(clip, space):
    faces = face_displacements(clip, space.timesteps)
    train = faces[~space.held_out]
    for timestep, face in zip(space.timesteps, faces):
        if timestep in space.novelty_mm:
            rms = np.sqrt(((train - face) ** 2).sum(axis=2).mean(axis=1))
            assert space.novelty_mm[timestep] == pytest.approx(rms.min(), rel=1e-6)
    assert set(space.novelty_mm) == {t for t, new in zip(space.timesteps, space.held_out) if new}


RNG = np.random.default_rng(7)


def keys_cubic(x):
    """Keys (1981), equation 4 with a = -1/2."""
    x = np.abs(x)
    near = 1.5 * x**3 - 2.5 * x**2 + 1
    far = -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    return np.where(x < 1, near, np.where(x < 2, far, 0))


def weights(before, after):
    """(after, before) float64: the widened kernel at pixel centres, renormalised at the border."""
    widening = max(1.0, before / after)
    centres = (np.arange(after)[:, None] + 0.5) * before / after
    values = keys_cubic((np.arange(before) + 0.5 - centres) / widening)
    return values / values.sum(axis=1, keepdims=True)


@pytest.mark.parametrize(("width", "height"), [(40, 48), (13, 17), (31, 9), (20, 41), (25, 24)])
def test_the_cubic_kernel_is_the_one_documented(width, height):
    image = RNG.random((24, 20, 3)).astype(np.float32)
    expected = np.einsum("yi,ijc,xj->yxc", weights(24, height), image.astype(float), weights(20, width))
    assert np.abs(resize_image(image, width, height) - expected).max() < 2e-6


def test_whole_factors_give_means_of_blocks():
    image = RNG.random((48, 36, 3)).astype(np.float32)
    expected = downscale_local_mean(image.astype(float), (4, 3, 1))
    assert np.abs(resize_image(image, 12, 12) - expected).max() < 2e-7
    assert resize_image(image[..., 0], 12, 12).shape == (12, 12)


@pytest.fixture
def train():
    """Faces that move along the first two of five directions, between -1 and 1 and between -0.5 and 0.5."""
    rng = np.random.default_rng(0)
    faces = np.zeros((200, 5))
    faces[:, :2] = rng.uniform(-1, 1, (200, 2)) * [1.0, 0.5]
    return faces


@pytest.mark.parametrize(
    ("direction", "outside", "beyond"),
    [
        ([0.9, 0.0, 0, 0, 0], 0.0, 0.0),
        ([0.6, -0.4, 0, 0, 0], 0.0, 0.0),
        ([1.5, 0.0, 0, 0, 0], 0.0, 1.0),
        ([0.0, 0.0, 0.8, 0, 0], 1.0, 0.0),
        ([0.3, 0.0, 0.4, 0, 0], 0.8, 0.0),
        ([1.5, 0.0, 2.0, 0, 0], 0.8, 1.0),
    ],
)
def test_shares_of_a_known_face(train, direction, outside, beyond):
    found = novelty(train - train.mean(0), np.array([direction, direction]))
    assert found.outside == pytest.approx(outside, abs=0.02)
    assert found.beyond == beyond


def test_noise_of_training_is_no_part_of_its_span(train):
    noisy = train + np.random.default_rng(1).normal(0, 0.01, train.shape)
    assert novelty(noisy, np.array([[0.0, 0, 0, 0.8, 0]])).outside > 0.95


def test_shares_of_timesteps_and_of_training_that_never_moves(train):
    assert novelty(train, np.array([[0.5, 0, 0, 0, 0], [2.0, 0, 0, 0, 0]])).beyond == 0.5
    still = np.zeros((9, 5))
    assert novelty(still, np.ones((2, 5))) == (1.0, 1.0)
    assert novelty(still, still[:2]) == (0.0, 0.0)
