"""Runs of numbers, near-duplicates, the choice of views."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.progress import counted
from headbench.datasets.ga.transforms import read_transforms
from headbench.datasets.lint.rules import spans
from headbench.datasets.lint.views import (
    _fringe,
    make_thumbnails,
    near_duplicates,
    pick_views,
    pixels_of_files,
)

from .good_capture import read_rgb, write_pixels


@given(st.sets(st.integers(0, 60)))
def test_spans_name_every_number_once(numbers):
    text = spans(numbers, limit=1000)
    named: list[int] = []
    for part in filter(None, text.split(", ")):
        first, _, last = part.partition("-")
        named += range(int(first), int(last or first) + 1)
    assert named == sorted(numbers)


def test_long_lists_are_cut_and_counted():
    assert spans([0, 2, 4, 6, 8, 10]) == "0, 2, 4, 6 and 2 more"
    assert (counted(1, "image"), counted(0, "image")) == ("1 image", "0 images")


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


@pytest.mark.parametrize(("noise", "shift", "twins"), [(1, 0, 10), (12, 0, 0), (0, 3, 0)])
def test_near_duplicates_survive_noise_and_not_motion(good, noise, shift, twins):
    """Frames saved again with a level of noise are found, each once; louder or moved ones are not."""
    entries = [e for e in read_transforms(good.union / "transforms_test.json") if e.camera_index == 1]
    white = pixels_of_files({}, (1, 1, 1)).image
    original = make_thumbnails({"one": entries}, white, 100)
    rng = np.random.default_rng(0)
    for entry in entries:
        image = read_rgb(entry.image).astype(int)
        image = (
            np.roll(image, shift, axis=1)
            + rng.integers(-1, 2, size=(20, 15, 1)).repeat(4, 0).repeat(4, 1) * noise
        )
        write_pixels(entry.image, np.clip(image, 0, 255).astype(np.uint8))
    again = make_thumbnails({"other": entries}, white, 100)
    pairs = list(near_duplicates(original, again))
    assert len(pairs) == twins
    assert all(a.entry.timestep == b.entry.timestep for a, b in pairs)
