import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from skimage.metrics import peak_signal_noise_ratio

from headbench.bench.errors import InputError
from headbench.metrics.psnr import CAP, psnr

PAIRS = st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(
    lambda size: st.tuples(*[npst.arrays(np.uint8, (*size, 3))] * 2)
)


@pytest.mark.parametrize(("level", "expected"), [(1, 48.1308036), (16, 24.0484), (255, 0.0)])
def test_a_constant_difference_has_a_closed_form(level, expected):
    black = np.zeros((5, 7, 3), np.uint8)
    assert psnr(black, black + np.uint8(level)) == pytest.approx(expected, abs=1e-4)


def test_one_pixel_of_many():
    truth = np.full((100, 50, 3), 128, np.uint8)
    image = truth.copy()
    image[3, 4, 1] += 10
    assert psnr(image, truth) == pytest.approx(10 * math.log10(255**2 * 15000 / 100), abs=1e-12)


def test_does_not_overflow_or_wrap_at_the_largest_difference():
    white = np.full((2000, 1000, 3), 255, np.uint8)
    assert psnr(np.zeros_like(white), white) == 0.0


def test_a_difference_too_small_to_matter_is_capped():
    truth = np.zeros((1000, 1000, 3), np.uint8)
    image = truth.copy()
    image[0, 0, 0] = 1
    assert psnr(image, truth) == CAP == 100.0


@settings(deadline=None)
@given(PAIRS)
def test_equals_scikit_image_and_is_symmetric(pair):
    image, truth = pair
    if np.array_equal(image, truth):
        assert psnr(image, truth) == CAP
        return
    assert psnr(image, truth) == pytest.approx(
        peak_signal_noise_ratio(truth, image, data_range=255), abs=1e-9
    )
    assert psnr(image, truth) == psnr(truth, image)


@settings(deadline=None)
@given(PAIRS, st.randoms(use_true_random=False))
def test_the_order_of_pixels_does_not_matter(pair, random):
    image, truth = pair
    order = list(range(image.shape[0] * image.shape[1]))
    random.shuffle(order)
    shuffled = [a.reshape(-1, 3)[order].reshape(a.shape) for a in pair]
    assert psnr(*shuffled) == psnr(image, truth)


@pytest.mark.parametrize(
    ("image", "truth", "expected"),
    [
        (np.zeros((4, 4, 3), np.float32), np.zeros((4, 4, 3), np.uint8), "8-bit unsigned"),
        (np.zeros((4, 4, 3), np.uint8), np.zeros((4, 5, 3), np.uint8), "shape of the truth"),
        (np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8), "height, width, 3"),
        (np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint8), "height, width, 3"),
        (np.zeros((0, 4, 3), np.uint8), np.zeros((0, 4, 3), np.uint8), "at least 1 pixels"),
    ],
)
def test_what_is_not_a_pair_of_frames_is_refused(image, truth, expected):
    with pytest.raises(InputError, match=expected):
        psnr(image, truth)
