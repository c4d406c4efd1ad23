"""Quantisation: bounds of errors, equal values in both directions, and the transform against a closed form."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from safetensors.numpy import load_file, save_file

from headbench.bench.errors import InputError
from headbench.methods.avatars.compact.coder import (
    CODEC,
    DATA,
    KEY,
    Coder,
    CoderInput,
    Content,
    codec_of,
    pack,
    read_content,
    scale_of,
    unpack,
    visibility_classes,
    write_content,
)
from headbench.methods.avatars.settings import EXACT, Precision

SHAPES = hnp.array_shapes(min_dims=1, max_dims=4, min_side=0, max_side=5)
WHOLE = hnp.arrays(np.int64, SHAPES, elements=st.integers(-(2**30), 2**30 - 1))
FLOATS = hnp.arrays(np.float32, SHAPES, elements=st.floats(width=32, allow_nan=False))


@given(st.one_of(WHOLE, FLOATS))
def test_packing_is_lossless(values):
    found = unpack(*pack(values))
    assert found.shape == values.shape
    np.testing.assert_array_equal(found, values)


def test_independent_numbers_take_about_their_entropy():
    values = np.rint(np.random.default_rng(0).normal(size=50_000) * 4).astype(np.int64)
    shares = np.unique(values, return_counts=True)[1] / len(values)
    entropy = -(shares * np.log2(shares)).sum() * len(values) / 8
    entry, _ = pack(values)
    assert entry.coding == "whole"
    assert entropy < entry.size < 1.06 * entropy


def test_sorted_numbers_are_stored_as_differences():
    values = np.sort(np.random.default_rng(0).integers(0, 10_000, 20_000))
    entry, _ = pack(values)
    assert entry.coding == "differences"
    assert entry.size < 20_000 * 1.6 / 8  # the differences have a mean of 0.5 and 1.38 bits of entropy


CONTENT = Content(
    {"a": np.arange(6).reshape(2, 3), "b": np.ones(4, np.float32), "none": np.zeros((0, 2), np.int64)},
    {"name": "x", CODEC: "4, steps x1"},
    {"s": 0.5},
)


@pytest.fixture
def path(tmp_path):
    write_content(tmp_path / "compact.safetensors", CONTENT)
    return tmp_path / "compact.safetensors"


def test_a_file_comes_back_whole(path):
    found = read_content(path)
    assert (found.text, found.steps, [*found.arrays]) == (CONTENT.text, CONTENT.steps, [*CONTENT.arrays])
    for name, values in CONTENT.arrays.items():
        np.testing.assert_array_equal(found.arrays[name], values)
        assert found.arrays[name].shape == values.shape
    first = path.read_bytes()
    sizes = write_content(path, CONTENT)
    assert path.read_bytes() == first
    assert sum(sizes.values()) == len(load_file(path)[DATA])
    assert (codec_of([path]), codec_of([path.with_name("avatar.safetensors")])) == ("4, steps x1", "")


def entry(**changes):
    return lambda header, _: header["arrays"]["a"].update(changes)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda header, _: header.update(version=2), "version 3"),
        (lambda header, _: header.pop("arrays"), "arrays"),
        (lambda header, _: header.update(arrays=[]), "arrays"),
        (lambda header, _: header["arrays"].pop("a"), "b: |bytes"),
        (entry(shape=[2, 4]), "a: expected an array of shape"),
        (entry(shape=[2**20, 2**20]), "at most"),
        (entry(shape=[2, -3]), "at most"),
        (entry(shape=[2.0, 3]), "shape"),
        (entry(coding="pickle"), "coding"),
        (entry(width=3), "width"),
        (entry(size=-1), "at most"),
        (entry(size=2), "a: "),
        (lambda header, _: header.update(steps={"s": float("nan")}), "steps"),
        (lambda header, _: header.update(steps={"s": "1"}), "steps"),
        (lambda header, _: header.update(text={"name": 1}), "name"),
        (lambda _, tensors: tensors.update(data=tensors[DATA][:-1]), "bytes|array"),
        (lambda _, tensors: tensors.update(data=np.append(tensors[DATA], np.uint8(0))), "bytes"),
        (lambda _, tensors: tensors.update(data=np.full(60, 255, np.uint8)), "a: "),
        (lambda _, tensors: tensors.update(data=np.zeros(9, np.float32)), "u1"),
        (lambda _, tensors: tensors.pop(DATA), "data"),
    ],
)
def test_a_damaged_file_is_an_input_error(path, change, says):
    from safetensors import safe_open

    with safe_open(path, "np") as file:
        header = json.loads(file.metadata()[KEY])
    tensors = dict(load_file(path))
    change(header, tensors)
    save_file(tensors, path, {KEY: json.dumps(header)})
    with pytest.raises(InputError, match=says):
        read_content(path)


def test_other_files_are_input_errors(path):
    data = path.read_bytes()
    for content in (b"", data[:40], data[:-3]):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"compact\.safetensors"):
            read_content(path)
    save_file({"a": np.zeros(3, np.uint8)}, path)
    with pytest.raises(InputError, match="coded avatar"):
        read_content(path)


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
