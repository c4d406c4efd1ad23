"""Tensors of safetensors files: what is no such file, or holds what no avatar can, is refused."""

from __future__ import annotations

import json
import struct

import pytest
import torch
from safetensors.torch import save

from headbench.bench.errors import InputError
from headbench.bench.io.arrays import Member
from headbench.methods.shared.tensor_files import MAX_HEADER, check_sizes, check_tensors, read_safetensors

from ...memory import memory_below


def file_of(header: object, data: bytes = b"") -> bytes:
    text = json.dumps(header).encode() if not isinstance(header, bytes) else header
    return struct.pack("<Q", len(text)) + text + data


def entry(dtype: str, shape: list, end: int) -> dict:
    return {"x": {"dtype": dtype, "shape": shape, "data_offsets": [0, end]}}


DAMAGED = {
    "too long": save({"x": torch.zeros(100)}) + b"\0",
    "a header as long as the world": struct.pack("<Q", 2**62) + b"{}",
    "a header of more than its share": file_of(b" " * (MAX_HEADER + 1)),
    "another size": file_of(entry("F32", [3], 4), bytes(4)),
    "huge": file_of(entry("F32", [2**40], 2**42)),
    "huge and empty": file_of(entry("F32", [0, 2**62], 0)),
    "an unknown type": file_of(entry("F33", [1], 4), bytes(4)),
    "no type": file_of({"x": 1}),
    "nested": file_of(b"[" * 100_000),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_file_is_refused(tmp_path, name):
    path = tmp_path / "x.safetensors"
    path.write_bytes(DAMAGED[name])
    with pytest.raises(InputError) as caught, memory_below(2**20):
        read_safetensors(path)
    assert caught.value.file == str(path)


def test_tensors_are_checked_as_arrays_are(tmp_path):
    path = tmp_path / "x.safetensors"
    tensors = {"x": torch.ones(3, 2), "b": torch.ones(2, dtype=torch.bfloat16), "other": torch.ones(1)}
    path.write_bytes(save(tensors, {"key": "text"}))
    read, metadata = read_safetensors(path)
    assert metadata == {"key": "text"}
    assert all(torch.equal(read[name], value) for name, value in tensors.items())
    assert check_tensors(path, read, {"x": Member("f", ("N", 2), 1, "f4")}) == {"N": 3}
    for name, member in {
        "x": Member("f", ("N", 3)),
        "b": Member("f"),
        "other": Member("f", most=0.5),
        "none": Member("f"),
    }.items():
        with pytest.raises(InputError) as caught:
            check_tensors(path, read, {name: member})
        assert caught.value.key == name


def test_sizes_that_overflow_are_refused(tmp_path):
    check_sizes(tmp_path, torch.tensor([[-200.0, 0.0, 29.0]]))
    check_sizes(tmp_path, torch.zeros(0, 3))
    with pytest.raises(InputError, match="logarithms"):
        check_sizes(tmp_path, torch.tensor([[-200.0, 0.0, 31.0]]))
