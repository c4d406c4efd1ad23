"""Tensors of safetensors files: what is no such file, or holds what no avatar can, is refused."""

import pytest
import torch
from safetensors.torch import save

from headbench.bench.errors import InputError
from headbench.bench.io.arrays import Member
from headbench.methods.shared.tensor_files import check_sizes, check_tensors, read_safetensors

WHOLE = save({"x": torch.zeros(100)})


@pytest.mark.parametrize("content", [WHOLE + b"\0", WHOLE[:-1], WHOLE[:40], b"", b"text"])
def test_a_damaged_file_is_refused(tmp_path, content):
    path = tmp_path / "x.safetensors"
    path.write_bytes(content)
    for wrong in (path, tmp_path / "none"):
        with pytest.raises(InputError) as caught:
            read_safetensors(wrong)
        assert caught.value.file == str(wrong)


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
