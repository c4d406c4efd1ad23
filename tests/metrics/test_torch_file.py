"""Files of ``torch.save``: what is read of them, and what is refused."""

from __future__ import annotations

import io
import os

import pytest
import torch

from headbench.bench.errors import InputError
from headbench.metrics.lpips_network import read_weights

BASE = torch.arange(24.0).reshape(2, 3, 4)
STATE = {
    "plain": BASE,
    "half": BASE[0].half(),
    "double": BASE[1].double(),
    "turned": BASE.permute(2, 0, 1),
    "expanded": torch.ones(1, 3).expand(1, 3),
    "scalar": torch.tensor(3.0),
    "empty": torch.zeros(0, 2),
    "parameter": torch.nn.Parameter(torch.ones(2)),
    "other": torch.arange(3, dtype=torch.int32),
}
WANTED = {name: tuple(value.shape) for name, value in STATE.items() if name != "other"}


def saved(state, new=True) -> bytes:
    stream = io.BytesIO()
    torch.save(state, stream, _use_new_zipfile_serialization=new)
    return stream.getvalue()


@pytest.mark.parametrize("new", [False, True])
def test_tensors_are_those_that_torch_reads(tmp_path, new):
    (tmp_path / "w.pth").write_bytes(saved(STATE, new))
    found = read_weights(tmp_path / "w.pth", WANTED)
    assert [*found] == [*WANTED]
    for name, values in found.items():
        assert torch.equal(values, STATE[name].detach().float())
        assert values.dtype == torch.float32


class Call:
    """Pickles as a call."""

    def __reduce__(self):
        return os.mkdir, ("made-by-a-pickle",)


DAMAGED = {
    "a sparse tensor": saved({"plain": torch.zeros(200).to_sparse()}),
    "another shape": saved({"plain": torch.zeros(201)}),
    "integers": saved({"plain": torch.zeros(200, dtype=torch.int32)}),
    "infinite numbers": saved({"plain": torch.full((200,), torch.inf)}),
    "no tensor": saved({"plain": 1}),
    "another name": saved({"other": torch.zeros(200)}),
    "a call": saved({"plain": Call()}),
    "a call in the old layout": saved({"plain": Call()}, new=False),
    "a truncated file": saved({"plain": torch.zeros(200)})[:-100],
    "an archive without a pickle": b"PK\x05\x06" + bytes(18),
    "a list": saved([1, 2]),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_other_files_are_refused_and_nothing_is_run(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "w.pth"
    path.write_bytes(DAMAGED[name])
    with pytest.raises(InputError) as caught:
        read_weights(path, {"plain": (200,)})
    assert caught.value.file == str(path)
    assert "weights_only" not in str(caught.value)
    assert [*tmp_path.iterdir()] == [path]
