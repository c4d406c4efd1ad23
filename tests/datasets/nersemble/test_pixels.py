"""Shrinking, compositing, un-blending, correcting: against float64 area means and a known composite."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from headbench.datasets.nersemble.pixels import AffineCorrection, prepare_pixels

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
