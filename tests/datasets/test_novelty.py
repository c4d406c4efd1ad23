"""How far a test is from training, on coefficients whose answer is known."""

import numpy as np
import pytest
from skimage.transform import downscale_local_mean

from headbench.datasets.inspect.statistics import novelty
from headbench.datasets.steps.for_method import resize_image

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
