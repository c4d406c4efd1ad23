"""The clip: lazy pixels, records, use from threads."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.datasets import images
from headbench.datasets.ga.reader import read_capture

from .tiny_capture import FRONTAL


def test_pixels_are_read_when_asked_for_and_held_within_the_bound(pristine_capture, monkeypatch):
    decoded = []
    original = images.read_pixels
    monkeypatch.setattr(
        images, "read_pixels", lambda path, *a, **k: decoded.append(path) or original(path, *a, **k)
    )
    bound = 5 * 64 * 48 * 3
    clip = read_capture(pristine_capture.union, cache_mb=bound / 1e6)
    assert decoded == []
    for _ in range(2):
        for key in clip.files:
            clip.image(key)
            assert clip.store.held_bytes <= bound
    assert len(decoded) == 2 * len(clip.files)  # a bound below one pass keeps nothing for the next


def test_threads_see_the_same_pixels(pristine_capture):
    clip = read_capture(pristine_capture.union, cache_mb=0.05)
    keys = [*clip.files] * 20
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(clip.image, keys))
    fresh = read_capture(pristine_capture.union)
    for key, image in zip(keys, found):
        np.testing.assert_array_equal(image, fresh.image(key))


def test_unknown_frame_is_named(pristine_capture):
    clip = read_capture(pristine_capture.union)
    with pytest.raises(InputError, match="901/FREE/00099/222200037"):
        clip.image(FrameKey("901", "FREE", 99, FRONTAL))


def test_derived_clip_shares_pixels_and_differs_in_fingerprint(pristine_capture):
    clip = read_capture(pristine_capture.union)
    derived = clip.derive("halve", {"factor": 2}, splits={"train": clip.splits["train"]})
    assert derived.steps[-1].input_fingerprint == clip.fingerprint != derived.fingerprint
    assert derived.store is clip.store
    assert derived.fingerprint == clip.derive("halve", {"factor": 2}, splits=derived.splits).fingerprint
    assert derived.fingerprint != clip.derive("halve", {"factor": 3}, splits=derived.splits).fingerprint


def test_fingerprint_covers_what_a_method_sees(pristine_capture):
    clip = read_capture(pristine_capture.union)
    changes = {
        "source_fingerprint": "other",
        "splits": {**clip.splits, "train": clip.splits["train"][1:]},
        "excluded": {},
        "background": np.zeros(3),
        "steps": clip.steps[:1],
    }
    found = {clip.fingerprint} | {
        replace(clip, **{name: value}).fingerprint for name, value in changes.items()
    }
    assert len(found) == len(changes) + 1
