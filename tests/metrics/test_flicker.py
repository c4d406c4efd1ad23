import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.metrics.flicker import flicker


def frames(seed, count=4, size=(6, 9, 3)):
    return np.random.default_rng(seed).integers(0, 256, (count, *size), dtype=np.uint8)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_equals_the_definition_in_float64_either_way_in_time(seed):
    image, truth, other, other_truth = frames(seed)
    change = (image.astype(float) - other) - (truth.astype(float) - other_truth)
    expected = np.sqrt((change**2).mean())
    assert flicker(image, truth, other, other_truth) == pytest.approx(expected, rel=1e-12)
    assert flicker(other, other_truth, image, truth) == pytest.approx(expected, rel=1e-12)


def test_a_constant_error_does_not_flicker_a_new_one_does():
    truth = frames(0, 2) // 2
    wrong = truth + np.uint8(40)
    assert flicker(wrong[0], truth[0], wrong[1], truth[1]) == 0.0
    assert flicker(truth[0], truth[0], wrong[1], truth[1]) == pytest.approx(40.0)


def test_the_largest_change_does_not_overflow():
    black, white = np.zeros((300, 200, 3), np.uint8), np.full((300, 200, 3), 255, np.uint8)
    assert flicker(white, black, black, white) == pytest.approx(510.0)


def test_frames_of_different_size_are_refused():
    image, truth, other, other_truth = frames(1)
    with pytest.raises(InputError, match="shape of the ground truth"):
        flicker(image, truth, other[1:], other_truth[1:])
