"""How far a test is from training, on coefficients whose answer is known."""

import numpy as np
import pytest

from headbench.datasets.novelty import novelty


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
