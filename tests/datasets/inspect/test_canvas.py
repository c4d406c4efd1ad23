"""Ticks are round, text fits, shapes land where they are told to."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.datasets.inspect.canvas import TRAIN, Canvas, nice_ticks, shortened, text_width


@given(st.floats(-1e4, 1e4), st.floats(1e-3, 1e4), st.integers(2, 8))
def test_ticks_are_round_even_and_inside(low, span, count):
    high = low + span
    ticks = np.array(nice_ticks(low, high, count))
    slack = 1e-6 * max(1.0, abs(low), span)
    assert (ticks >= low - slack).all()
    assert (ticks <= high + slack).all()
    assert len(ticks) <= 3 * count
    if len(ticks) > 1:
        steps = np.diff(ticks)
        mantissa = steps[0] / 10 ** np.floor(np.log10(steps[0]) + 1e-9)
        assert np.allclose(steps, steps[0], rtol=1e-6, atol=slack)
        assert min(abs(mantissa - m) for m in (1, 2, 5, 10)) < 1e-4 * max(1.0, slack / steps[0])


def test_ticks_of_a_plain_range():
    assert nice_ticks(0.0, 10.0) == pytest.approx([0, 2, 4, 6, 8, 10])


@given(st.text(alphabet="abcXYZ -", max_size=60), st.floats(10, 300))
def test_shortened_text_fits(text, limit):
    short = shortened(text, limit)
    assert text_width(short) <= limit or short == "…"
    if text_width(text) <= limit:
        assert short == text


def test_shapes_land_where_they_are_told_to():
    canvas = Canvas(60, 40)
    canvas.dot((45, 10), 4, TRAIN)
    canvas.image(5, 20, np.zeros((20, 30, 3), np.uint8))
    picture = canvas.finish()
    assert picture.shape == (40, 60, 3)
    assert tuple(picture[10, 45]) == TRAIN
    dark = np.argwhere(picture.max(axis=2) < 20)
    assert dark.min(axis=0).tolist() == pytest.approx([20, 5], abs=1)
    assert dark.max(axis=0).tolist() == pytest.approx([29, 19], abs=1)
