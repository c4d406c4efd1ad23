import numpy as np
import pytest

from headbench.bench.contracts import HeadPose
from headbench.datasets.synthetic.performance import with_tracking_noise


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    return [
        HeadPose(
            "m",
            rng.normal(0, [1.0, 4.0, 0.0], 3),
            *rng.normal(0, 0.1, (3, 3)),
            rng.normal(0, 1, 6),
            np.zeros(3),
        )
        for _ in range(4000)
    ]


def test_zero_noise_changes_nothing(poses):
    assert with_tracking_noise(poses, 0.0, 1) == poses


def test_noise_is_the_stated_fraction_of_each_deviation(poses):
    noisy = with_tracking_noise(poses, 0.1, 1)
    error = np.stack([a.expression - b.expression for a, b in zip(noisy, poses)])
    np.testing.assert_allclose(error.std(0), [0.1, 0.4, 0.0], rtol=0.06, atol=1e-7)
    assert all((a.translation == 0).all() for a in noisy)
    assert with_tracking_noise(poses, 0.1, 1)[7].jaw.tolist() == noisy[7].jaw.tolist()
