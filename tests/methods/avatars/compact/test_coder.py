"""Quantisation: bounds of errors, equal values in both directions, and the transform against a closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from headbench.methods.avatars.compact.coder import Coder, CoderInput, pack, scale_of, visibility_classes
from headbench.methods.avatars.settings import EXACT, Precision


def both(values, code, precision=EXACT, **more):
    """What a call gives when it encodes and when it decodes, which must be equal; and the encoder."""
    encoder = Coder(precision, {}, CoderInput({"x": values}, **more))
    found = code(encoder)
    assert not encoder.left
    decoder = Coder(precision, {}, encoder.arrays)
    np.testing.assert_array_equal(code(decoder), found)
    assert not decoder.left
    return found, encoder


@given(
    hnp.arrays(
        np.float32, st.tuples(st.integers(0, 20), st.just(3)), elements=st.floats(-100, 100, width=32)
    ),
    st.floats(1e-3, 0.9),
    st.floats(0.1, 8),
)
def test_rounding_errs_by_half_a_step_at_most(values, step, unit):
    precision = SimpleNamespace(scales=step)
    found, _ = both(values, lambda coder: coder.rounded("x", "scales", unit, base=1.5), precision)
    assert np.all(np.abs(found.astype(float) - values) <= 0.5 * step * unit + 1e-5)


def test_step_0_is_exact():
    values = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    calls = (
        lambda coder: coder.rounded("x", "scales", 7.0),
        lambda coder: coder.matrix("x", "networks", 0.0),
        lambda coder: coder.vectors("x", "colors"),
        lambda coder: coder.vectors("x", "colors", 1.0, units=np.zeros((5, 3))),
    )
    for code in calls:
        np.testing.assert_array_equal(both(values, code)[0], values)


@given(st.integers(0, 2**32 - 1))
def test_weights_are_rounded_relative_to_their_row(seed):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(6, 2, 3, 3)) * 10.0 ** rng.integers(-4, 4, (6, 1, 1, 1))
    values[2] = 0
    found, _ = both(values, lambda coder: coder.matrix("x", "networks", 1 / 64))
    largest = np.abs(values).max((1, 2, 3), keepdims=True)
    assert np.all(np.abs(found - values) <= (0.5 / 64 + 1e-6) * largest)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.5))
def test_the_visible_error_of_vectors_is_bounded(seed, step):
    """An error e has the visible square e M e; half a step in each coordinate is the bound, if all are kept."""
    rng = np.random.default_rng(seed)
    values, factor = rng.normal(size=(80, 4)) * 50, rng.normal(size=(4, 4)) + 3 * np.eye(4)
    metric, scale = factor @ factor.T, 2.0 ** rng.integers(0, 3, (80, 1))
    code = lambda coder: coder.vectors("x", "colors", step, scale=scale)
    found, encoder = both(values, code, metrics={"x": metric})
    error = found - values
    visible = np.sqrt(np.einsum("nc,cd,nd->n", error, metric, error))
    # The basis itself is rounded to 1/1024.
    size = np.sqrt(np.einsum("nc,cd,nd->n", values, metric, values))
    assert encoder.arrays["x"].shape[1] == 4
    assert np.all(visible <= step * scale[:, 0] + 0.02 * size)


def test_the_transform_removes_what_is_common_to_columns():
    """Twelve columns that are multiples of two hidden ones take two coordinates."""
    rng = np.random.default_rng(0)
    hidden = rng.normal(size=(5000, 2))
    values = hidden @ rng.normal(size=(2, 12))
    found, encoder = both(values, lambda coder: coder.vectors("x", "colors", 0.05))
    assert encoder.arrays["x"].shape == (5000, 2)
    assert np.sqrt(np.mean((found - values) ** 2)) < 0.05
    alone = np.rint(values / 0.05).astype(np.int64)
    assert pack(encoder.arrays["x"])[0].size < pack(alone)[0].size / 4


def test_an_error_is_half_as_visible_in_the_next_class():
    weights = 4.0 ** -np.arange(8)
    classes = visibility_classes(weights, 8)
    assert np.all(np.diff(classes)[:6] == 1)
    seen = scale_of(classes)[:, 0] ** 2 * weights
    assert seen[:6].max() < 1.01 * seen[:6].min()
    assert not visibility_classes(None, 3).any()
    assert not visibility_classes(np.zeros(3), 3).any()


def test_steps_outside_their_range_are_refused():
    for value in (-0.1, 1.0, float("nan")):
        with pytest.raises(ValueError, match="planes"):
            Precision(planes=value)
    for value in (0.0, -1.0, 1e9, float("nan")):
        with pytest.raises(ValueError, match="step"):
            Precision(step=value)
