"""JOD, computed by a program that is not a dependency: what it is called with, and what its absence gives."""

import sys
import types

import numpy as np
import pytest

from headbench.bench.errors import InputError, UnavailableError
from headbench.metrics import jod


@pytest.fixture
def program(monkeypatch):
    """A stand-in that records how it is called; its JOD falls by one for each level of the mean difference."""
    calls = []

    class Predictor:
        def __init__(self, **settings):
            calls.append(settings)

        def predict(self, test, reference, dim_order, frames_per_second):
            calls.append((test.shape, dim_order, frames_per_second))
            return np.float32(10 - np.abs(test.astype(float) - reference).mean()), {}

    for package, name in (("pyfvvdp", "fvvdp"), ("pycvvdp", "cvvdp")):
        module = types.ModuleType(package)
        setattr(module, name, Predictor)
        monkeypatch.setitem(sys.modules, package, module)
    jod._program.cache_clear()
    yield calls
    jod._program.cache_clear()


def frames(count, level):
    return [np.full((40, 30, 3), level, np.uint8) for _ in range(count)]


@pytest.mark.parametrize("metric", [jod.Jod, jod.ColorJod])
def test_a_sequence_is_a_video_on_the_display_of_the_benchmark(program, metric):
    assert metric()(frames(5, 103), frames(5, 100)) == pytest.approx(7.0)
    assert program == [
        {"display_name": "standard_4k", "heatmap": None, "quiet": True},
        ((5, 40, 30, 3), "FHWC", 24.3),
    ]


def test_a_single_frame_is_a_still_picture(program):
    assert jod.Jod()(frames(1, 100), frames(1, 100)) == 10.0
    assert program[-1] == ((1, 40, 30, 3), "FHWC", 0)


def test_pictures_of_other_sizes_are_refused(program):
    with pytest.raises(InputError):
        jod.Jod()([np.zeros((40, 30, 3), np.uint8)], [np.zeros((40, 31, 3), np.uint8)])


@pytest.mark.parametrize(
    ("metric", "needs", "remedy"),
    [
        (jod.Jod, jod.needs, r"package pyfvvdp[\s\S]*CC BY-NC 4.0[\s\S]*pip install"),
        (jod.ColorJod, jod.color_needs, r"package pycvvdp[\s\S]*torchvision[\s\S]*pip install"),
    ],
)
def test_without_the_program_the_reason_says_how_to_install_it(monkeypatch, metric, needs, remedy):
    monkeypatch.setitem(sys.modules, metric.package, None)
    monkeypatch.setattr(jod, "find_spec", lambda name: None)
    jod._program.cache_clear()
    with pytest.raises(UnavailableError, match=remedy):
        metric()(frames(2, 0), frames(2, 0))
    (need,) = needs(None, "cpu")
    assert (need.found, need.required) == ("", False)
