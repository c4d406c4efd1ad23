"""The file of a coded avatar: what goes in comes out, and a damaged file is refused."""

import json

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
    Content,
    codec_of,
    pack,
    read_content,
    unpack,
    write_content,
)

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
