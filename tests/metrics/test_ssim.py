import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from headbench.bench.errors import InputError
from headbench.metrics.ssim import gaussian_window, ssim, ssim_map


def noisy_pair(seed, height=24, width=19, noise=25.0):
    """A smooth random image, and the same with noise, as 8-bit."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width][..., None]
    waves = np.sin(y * rng.uniform(0.05, 0.8, 3) + x * rng.uniform(0.05, 0.8, 3) + rng.uniform(0, 6, 3))
    truth = 127 + 120 * waves
    image = truth + rng.normal(0, noise, truth.shape)
    return tuple(np.clip(a, 0, 255).round().astype(np.uint8) for a in (image, truth))


def brute_force_map(image, truth):
    """The definition, window by window, with weighted means taken about the mean."""
    offsets = np.arange(-5, 6)
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    height, width, channels = image.shape
    out = np.empty((height - 10, width - 10, channels))
    for i, j, c in np.ndindex(*out.shape):
        x, y = (a[i : i + 11, j : j + 11, c].astype(float) for a in (image, truth))
        mx, my = (weights * x).sum(), (weights * y).sum()
        vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
        cov = (weights * (x - mx) * (y - my)).sum()
        c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
        out[i, j, c] = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    return out


def test_the_map_equals_a_loop_over_windows():
    pair = noisy_pair(0)
    np.testing.assert_allclose(ssim_map(*pair), brute_force_map(*pair), atol=1e-10)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(11, 40), st.integers(11, 40), st.floats(0, 90))
def test_equals_scikit_image_and_is_symmetric(seed, height, width, noise):
    image, truth = noisy_pair(seed, height, width, noise)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = structural_similarity(image, truth, channel_axis=2, data_range=255, **options)
    assert ssim(image, truth) == pytest.approx(expected, abs=1e-6)
    assert ssim(image, truth) == pytest.approx(ssim(truth, image), abs=1e-12)
    assert ssim(image, truth) <= 1.0 + 1e-12


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_identity_and_permutations_of_channels_and_axes(seed):
    image, truth = noisy_pair(seed)
    assert ssim(truth, truth) == pytest.approx(1.0, abs=1e-12)
    value = ssim(image, truth)
    assert ssim(image[..., [2, 0, 1]], truth[..., [2, 0, 1]]) == pytest.approx(value, abs=1e-12)
    assert ssim(image[::-1], truth[::-1]) == pytest.approx(value, abs=1e-12)
    assert ssim(image.swapaxes(0, 1), truth.swapaxes(0, 1)) == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize(("a", "b"), [(0, 255), (100, 120), (255, 255)])
def test_constant_images_have_a_closed_form(a, b):
    c1 = (0.01 * 255) ** 2
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    image, truth = (np.full((15, 13, 3), level, np.uint8) for level in (a, b))
    assert ssim(image, truth) == pytest.approx(expected, abs=1e-9)


def test_the_window_is_a_normalised_gaussian():
    window = gaussian_window()
    assert window.shape == (11,)
    assert window.sum() == pytest.approx(1.0, abs=1e-15)
    assert window[5] / window[8] == pytest.approx(np.exp(9 / (2 * 2.25)))


def test_an_image_smaller_than_the_window_is_refused():
    small = np.zeros((10, 40, 3), np.uint8)
    with pytest.raises(InputError, match="at least 11 pixels"):
        ssim(small, small)
