import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from skimage.metrics import peak_signal_noise_ratio

from headbench.bench.errors import InputError
from headbench.metrics.psnr import CAP, psnr, psnr_by_channel, psnr_floored

PAIRS = st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(
    lambda size: st.tuples(*[npst.arrays(np.uint8, (*size, 3))] * 2)
)


@pytest.mark.parametrize(("level", "expected"), [(1, 48.1308036), (16, 24.0484), (255, 0.0)])
def test_a_constant_difference_has_a_closed_form(level, expected):
    black = np.zeros((5, 7, 3), np.uint8)
    assert psnr(black, black + np.uint8(level)) == pytest.approx(expected, abs=1e-4)


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


@pytest.mark.parametrize(
    ("image", "truth", "dtype", "expected"),
    [
        *(((4, 4, 3), (4, 4, 3), t, "quantise") for t in (np.uint16, np.float32, np.int8, bool)),
        ((4, 4, 3), (4, 5, 3), np.uint8, "shape of the ground truth"),
        ((4, 4, 4), (4, 4, 4), np.uint8, "height, width, 3"),
        ((4, 4), (4, 4), np.uint8, "height, width, 3"),
        ((0, 4, 3), (0, 4, 3), np.uint8, "height, width, 3"),
    ],
)
def test_what_is_not_a_pair_of_frames_is_refused(image, truth, dtype, expected):
    with pytest.raises(InputError, match=expected):
        psnr(np.zeros(image, dtype), np.zeros(truth, np.uint8))


@settings(deadline=None)
@given(PAIRS)
def test_by_channel_is_the_mean_of_three_and_never_below(pair):
    image, truth = pair
    single = [psnr(*(np.repeat(a[..., c : c + 1], 3, axis=2) for a in pair)) for c in range(3)]
    assert psnr_by_channel(image, truth) == pytest.approx(np.mean(single), abs=1e-9)
    assert psnr_by_channel(image, truth) >= psnr(image, truth) - 1e-9


def test_the_floored_form_ends_at_80_db():
    grey = np.full((4, 4, 3), 9, np.uint8)
    assert psnr_floored(grey, grey) == pytest.approx(80.0)
    assert psnr_floored(grey, grey + np.uint8(51)) == pytest.approx(-10 * math.log10(0.04 + 1e-8))


@settings(deadline=None)
@given(PAIRS, st.integers(0, 2**32 - 1))
def test_a_region_is_scored_by_its_own_pixels(pair, seed):
    image, truth = pair
    inside = np.random.default_rng(seed).random(image.shape[:2]) < 0.5
    values = psnr.in_regions(image, truth, {"part": inside, "none": inside & ~inside, "all": inside | True})
    assert values["all"] == psnr(image, truth)
    assert "none" not in values
    assert ("part" in values) == inside.any()
    if inside.any():
        assert values["part"] == psnr(image[inside][None], truth[inside][None])


def test_a_white_surround_dilutes_the_frame_and_not_the_region():
    """A tenth of the pixels differ: the frame's error is a tenth of the region's, 10 dB."""
    truth = np.full((10, 100, 3), 255, np.uint8)
    image = truth.copy()
    inside = np.zeros((10, 100), bool)
    inside[:, :10] = True
    image[inside] -= 20
    assert psnr(image, truth) - psnr.in_regions(image, truth, {"face": inside})["face"] == pytest.approx(10.0)


def test_sums_beyond_32_bits_are_exact():
    white = np.full((3000, 2000, 3), 255, np.uint8)
    assert psnr(np.zeros_like(white), white) == 0.0
