"""The lossless coder and its container: what goes in comes out, and what was tampered with is refused unopened."""

import json
import lzma

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from safetensors.numpy import load_file, save_file
from scipy.spatial.transform import Rotation

from headbench.bench.errors import InputError
from headbench.methods.avatars.compact.container import (
    DTYPES,
    KEY,
    MAX_BYTES,
    Content,
    dequantise,
    from_smallest_three,
    pack,
    quantise,
    read_content,
    smallest_three,
    unpack,
    write_content,
)

SHAPES = hnp.array_shapes(min_dims=1, max_dims=4, min_side=0, max_side=5)


@given(st.sampled_from(sorted(DTYPES)).flatmap(lambda name: hnp.arrays(DTYPES[name], SHAPES)))
def test_packing_is_lossless(values):
    found = unpack(pack(values), values.dtype.str[1:], values.shape)
    assert found.dtype == values.dtype
    assert found.shape == values.shape
    assert found.tobytes() == np.ascontiguousarray(values).tobytes()


def test_numbers_of_low_entropy_take_about_their_entropy():
    rng = np.random.default_rng(0)
    values = np.abs(np.rint(rng.normal(size=50_000) * 4)).astype(np.uint8)
    counts = np.bincount(values)
    probability = counts[counts > 0] / len(values)
    entropy = -(probability * np.log2(probability)).sum() * len(values) / 8
    assert len(pack(values)) < 1.06 * entropy


def test_a_stream_of_another_size_is_refused():
    values = np.arange(100, dtype=np.uint16)
    for shape in ((99,), (101,), (0,)):
        with pytest.raises(ValueError, match="bytes"):
            unpack(pack(values), "u2", shape)
    for damaged in (pack(values)[:-4], pack(values) + b"more"):
        with pytest.raises(ValueError, match="stream"):
            unpack(damaged, "u2", (100,))


def test_a_bomb_is_left_before_it_is_unpacked(monkeypatch):
    bomb = pack(np.zeros(20_000_000, np.uint8))
    assert len(bomb) < 10_000
    longest = []
    decoder = lzma.LZMADecompressor

    class Watched:
        def __init__(self, **arguments):
            self._decoder = decoder(**arguments)

        def decompress(self, data, max_length):
            content = self._decoder.decompress(data, max_length=max_length)
            longest.append(len(content))
            return content

        def __getattr__(self, name):
            return getattr(self._decoder, name)

    monkeypatch.setattr(lzma, "LZMADecompressor", Watched)
    with pytest.raises(ValueError, match="other than 100 bytes"):
        unpack(bomb, "u1", (100,))
    assert max(longest) <= 101
    with pytest.raises(ValueError, match="more than"):
        unpack(bomb, "u1", (MAX_BYTES + 1,))


CONTENT = Content(
    {"a": np.arange(6, dtype=np.uint16).reshape(2, 3), "b": np.ones(4, np.float32)},
    {"name": "x"},
    {"s": 0.5},
)


def test_a_container_comes_back_whole(tmp_path):
    path = tmp_path / "x.safetensors"
    write_content(path, CONTENT)
    found = read_content(path)
    assert found.text == CONTENT.text
    assert found.steps == CONTENT.steps
    assert set(found.arrays) == set(CONTENT.arrays)
    for name, values in CONTENT.arrays.items():
        np.testing.assert_array_equal(found.arrays[name], values)
    first = path.read_bytes()
    write_content(path, CONTENT)
    assert path.read_bytes() == first


def tampered(path, change):
    """The file with its layout changed."""
    write_content(path, CONTENT)
    tensors = load_file(path)
    layout = {"version": 2, "text": {"name": "x"}, "steps": {"s": 0.5}}
    layout["arrays"] = {"a": ["u2", [2, 3]], "b": ["f4", [4]]}
    change(layout, tensors)
    save_file(tensors, path, {KEY: json.dumps(layout)})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda layout, _: layout.update(version=3), "version 1"),
        (lambda layout, _: layout.update(tables=[["a", "c"]]), "lists of names"),
        (lambda layout, _: layout.update(tables=[["a"], ["a"]]), "lists of names"),
        (lambda layout, _: layout.update(tables=["a"]), "lists of names"),
        (lambda layout, _: layout.update(tables=[["a"]]), "stream"),
        (lambda layout, _: layout["arrays"].pop("a"), "no others"),
        (lambda layout, _: layout["arrays"].update(a=["u2", [2, 4]]), "16 bytes"),
        (lambda layout, _: layout["arrays"].update(a=["u2", [2**20, 2**20]]), "at most"),
        (lambda layout, _: layout["arrays"].update(a=["u2", [2, -3]]), "type, shape"),
        (lambda layout, _: layout["arrays"].update(a=["u2", [2.0, 3]]), "type, shape"),
        (lambda layout, _: layout["arrays"].update(a=["O", [2, 3]]), "type, shape"),
        (lambda layout, _: layout["arrays"].update(a="u2"), "type, shape"),
        (lambda layout, _: layout.update(arrays=[]), "type, shape"),
        (lambda layout, _: layout.update(steps={"s": float("nan")}), "steps.s: expected a finite"),
        (lambda layout, _: layout.update(steps={"s": 1e9}), "numbers from 0 to 1"),
        (lambda layout, _: layout.update(steps={"s": True}), "numbers from 0 to 1"),
        (lambda layout, _: layout.update(text={"name": 1}), "strings"),
        (lambda _, tensors: tensors.update(a=np.zeros((2, 2), np.uint8)), "shape"),
        (lambda _, tensors: tensors.update(a=np.zeros(9, np.float32)), "u1"),
        (lambda _, tensors: tensors.update(a=np.full(9, 255, np.uint8)), "stream"),
    ],
)
def test_a_tampered_container_is_an_input_error(tmp_path, change, says):
    path = tmp_path / "x.safetensors"
    tampered(path, change)
    with pytest.raises(InputError, match=says):
        read_content(path)


def test_a_file_of_version_1_is_read(tmp_path):
    path = tmp_path / "x.safetensors"
    streams = {name: np.frombuffer(pack(values), np.uint8) for name, values in CONTENT.arrays.items()}
    arrays = {name: [values.dtype.str[1:], list(values.shape)] for name, values in CONTENT.arrays.items()}
    layout = {"version": 1, "text": CONTENT.text, "steps": CONTENT.steps, "arrays": arrays}
    save_file(streams, path, {KEY: json.dumps(layout)})
    found = read_content(path)
    for name, values in CONTENT.arrays.items():
        np.testing.assert_array_equal(found.arrays[name], values)


def test_another_safetensors_file_is_an_input_error(tmp_path):
    path = tmp_path / "x.safetensors"
    save_file({"a": np.zeros(3, np.uint8)}, path)
    with pytest.raises(InputError, match="compact avatar"):
        read_content(path)


@given(
    hnp.arrays(np.float32, st.integers(0, 30), elements=st.floats(-100, 100, width=32)),
    st.floats(1e-3, 0.9),
)
def test_rounding_errs_by_half_a_step_at_most(values, step):
    found = dequantise(quantise(values, step), step)
    assert np.all(np.abs(found.astype(float) - values) <= 0.5 * step + 1e-5)


@pytest.mark.parametrize(("largest", "dtype"), [(127, np.uint8), (128, np.uint16), (32768, np.uint32)])
def test_the_smallest_type_is_taken(largest, dtype):
    values = np.array([0.0, -largest, largest])
    folded = quantise(values, 1.0)
    assert folded.dtype == dtype
    np.testing.assert_array_equal(dequantise(folded, 1.0), values)


def test_what_no_integer_holds_is_clamped():
    found = dequantise(quantise(np.array([1e30, -1e30]), 0.5), 0.5)
    np.testing.assert_allclose(found, [2.0**29, -(2.0**29)], rtol=1e-6)


def covariance(quats, scales):
    """By another library."""
    turn = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    return turn @ (scales[:, :, None] ** 2 * turn.transpose(0, 2, 1))


@given(st.integers(0, 2**32 - 1))
def test_three_components_turn_a_gaussian_the_same(seed):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(40, 4)) * rng.uniform(0.1, 5, size=(40, 1))
    scales = rng.uniform(0.01, 1, size=(40, 3))
    imaginary = smallest_three(quats)
    assert np.abs(imaginary).max() <= 0.5**0.5 + 1e-12
    found = from_smallest_three(imaginary)
    assert np.all(found[:, 0] >= np.abs(found[:, 1:]).max(1) - 1e-6)
    np.testing.assert_allclose(covariance(found, scales), covariance(quats, scales), atol=1e-6)


def test_components_too_large_for_a_unit_still_give_one():
    found = from_smallest_three(np.array([[0.8, 0.8, 0.8], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-6)
