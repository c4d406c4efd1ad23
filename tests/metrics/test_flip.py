import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.metrics.flip import PIXELS_PER_DEGREE, Flip, flip


def constant(rgb, size=(40, 50)):
    return np.full((*size, 3), rgb, np.uint8)


def test_the_default_viewer_is_that_of_the_paper():
    assert pytest.approx(67.0206, abs=1e-4) == PIXELS_PER_DEGREE


def test_green_against_blue_is_the_largest_constant_error():
    """Section 4.1.5: the two hues that are farthest apart are at 1."""
    assert flip(constant((0, 255, 0)), constant((0, 0, 255))) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("level", [13, 60, 140, 250])
def test_constant_greys_have_a_closed_form(level):
    """Greys differ in lightness alone: HyAB is the difference of L*, compressed and stretched."""
    other = 100

    def lightness(value):
        value /= 255
        y = value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
        return 116 * np.cbrt(y) - 16 if y > (6 / 29) ** 3 else y * (29 / 3) ** 3

    # green against blue, hand-computed from their Lab coordinates with the Hunt adjustment
    green, blue = (87.7370, -86.1846, 83.1812), (32.3026, 79.1967, -107.8637)
    hunt = [(l, 0.01 * l * a, 0.01 * l * b) for l, a, b in (green, blue)]
    (l0, a0, b0), (l1, a1, b1) = hunt
    largest = (abs(l0 - l1) + math.hypot(a0 - a1, b0 - b1)) ** 0.7
    error = abs(lightness(level) - lightness(other)) ** 0.7
    knee = 0.4 * largest
    expected = error * 0.95 / knee if error < knee else 0.95 + (error - knee) / (largest - knee) * 0.05
    image, truth = constant((level,) * 3), constant((other,) * 3)
    assert flip(image, truth) == pytest.approx(expected, abs=2e-4)


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 2**32 - 1), st.floats(5, 80))
def test_it_is_a_symmetric_error_in_the_unit_interval(seed, pixels_per_degree):
    image, truth = np.random.default_rng(seed).integers(0, 256, (2, 21, 17, 3), dtype=np.uint8)
    metric = Flip(pixels_per_degree)
    error = metric.map(image, truth)
    assert error.shape == (21, 17)
    assert error.min() >= 0
    assert error.max() <= 1 + 1e-12
    np.testing.assert_allclose(error, metric.map(truth, image), atol=1e-12)
    np.testing.assert_allclose(error[:, ::-1], metric.map(image[:, ::-1], truth[:, ::-1]), atol=1e-9)
    np.testing.assert_allclose(error.T, metric.map(image.swapaxes(0, 1), truth.swapaxes(0, 1)), atol=1e-9)


def test_identical_images_have_none():
    image = np.random.default_rng(0).integers(0, 256, (30, 20, 3), dtype=np.uint8)
    assert flip(image, image) == 0.0


def test_seen_from_farther_a_checkerboard_melts_into_its_mean():
    """Linear light averages: black and white melt into the grey of half the light, 188 of 255."""
    board = np.indices((64, 64)).sum(axis=0) % 2 * 255
    board, grey = np.repeat(board[..., None], 3, axis=2).astype(np.uint8), constant((188,) * 3, (64, 64))
    near, far = (Flip(ppd)(board, grey) for ppd in (8, 300))
    assert near > 0.5
    assert far < near / 4


def test_regions_are_means_of_the_map():
    image, truth = np.random.default_rng(1).integers(0, 256, (2, 30, 20, 3), dtype=np.uint8)
    part = np.zeros((30, 20), bool)
    part[3:9, 4:11] = True
    values = flip.in_regions(image, truth, {"part": part, "none": part & ~part})
    assert values == {"part": pytest.approx(flip.map(image, truth)[part].mean())}


def test_one_pixel_has_an_error_and_floats_are_refused():
    assert 0 < flip(constant((9, 9, 9), (1, 1)), constant((99, 9, 9), (1, 1))) < 1
    with pytest.raises(InputError, match="quantise"):
        flip(np.zeros((4, 4, 3)), constant((0, 0, 0), (4, 4)))
