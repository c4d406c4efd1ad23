"""The clip: lazy pixels, records, use from threads."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.datasets import images
from headbench.datasets.ga.reader import read_capture

from .tiny_capture import FRONTAL


def test_pixels_are_read_when_asked_for(pristine_capture, monkeypatch):
    decoded = []
    original = images.read_pixels
    monkeypatch.setattr(images, "read_pixels", lambda path: decoded.append(path) or original(path))
    clip = read_capture(pristine_capture.union, cache_mb=1)
    assert decoded == []
    key = next(iter(clip.files))
    for _ in range(2):
        clip.image(key)
    assert decoded == [clip.files[key].image]


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
