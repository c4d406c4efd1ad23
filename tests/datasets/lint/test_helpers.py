"""Runs of numbers, near-duplicates, the choice of views."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.datasets.ga.transforms import read_transforms
from headbench.datasets.lint.rules import spans
from headbench.datasets.lint.views import (
    _fringe,
    pick_views,
)


@given(st.sets(st.integers(0, 60)))
def test_spans_name_every_number_once(numbers):
    text = spans(numbers, limit=1000)
    named: list[int] = []
    for part in filter(None, text.split(", ")):
        first, _, last = part.partition("-")
        named += range(int(first), int(last or first) + 1)
    assert named == sorted(numbers)


@given(st.floats(0.2, 1.0), st.floats(0.0, 1.0), st.floats(0.5, 2.0))
def test_the_fringe_of_a_composite_is_the_factor_on_its_light(subject, ground, factor):
    """I = k a F + (1 - a) B has the fringe k, closed form, wherever nothing saturates."""
    alpha = np.tile(np.clip((np.arange(40) - 14) / 5, 0, 1), (40, 1))
    colour = subject * (np.where(alpha < 0.98, factor, 1.0) * alpha)
    image = colour + (1 - alpha) * ground
    if image.max() > 1:
        return
    mask = np.round(alpha * 255).astype(np.uint8)
    pixels = np.repeat(np.round(image * 255).astype(np.uint8)[..., None], 3, axis=2)
    found = _fringe(pixels, mask, np.full(3, 255 * ground))
    assert found == pytest.approx(factor, abs=0.05)


def test_views_cover_timesteps_and_cameras(pristine):
    entries = read_transforms(pristine.union / "transforms_test.json")
    picked = pick_views(entries, 10)
    assert sorted(entry.timestep for entry in picked) == sorted({entry.timestep for entry in entries})
    assert len({entry.camera_id for entry in picked}) == 4
    assert len(pick_views(entries, 1000)) <= len(entries)
    assert pick_views([], 5) == pick_views(entries, 0) == []
