"""Files of ``torch.save``: what is read of them, and what is refused."""

from __future__ import annotations

import io
import os
import struct
import zipfile

import pytest
import torch

from headbench.bench.errors import InputError
from headbench.metrics.torch_file import read_weights

from ..memory import memory_below

BASE = torch.arange(24.0).reshape(2, 3, 4)
STATE = {
    "plain": BASE,
    "half": BASE[0].half(),
    "double": BASE[1].double(),
    "turned": BASE.permute(2, 0, 1),
    "part": BASE[1:, 1],
    "expanded": torch.ones(1, 3).expand(1, 3),
    "scalar": torch.tensor(3.0),
    "empty": torch.zeros(0, 2),
    "parameter": torch.nn.Parameter(torch.ones(2)),
    "other": torch.arange(3, dtype=torch.int32),
}
WANTED = {name: tuple(value.shape) for name, value in STATE.items() if name != "other"}
OLD, NEW = ({"_use_new_zipfile_serialization": new} for new in (False, True))


def saved(state, layout) -> bytes:
    stream = io.BytesIO()
    torch.save(state, stream, **layout)
    return stream.getvalue()


@pytest.mark.parametrize("layout", [OLD, NEW])
def test_tensors_are_those_that_torch_reads(tmp_path, layout):
    module = torch.nn.Sequential(torch.nn.Linear(2, 3))
    for number, (state, wanted) in enumerate([(STATE, WANTED), (module.state_dict(), {"0.weight": (3, 2)})]):
        path = tmp_path / f"{number}.pth"
        path.write_bytes(saved(state, layout))
        found = read_weights(path, wanted)
        assert [*found] == [*wanted]
        for name, values in found.items():
            assert torch.equal(values, state[name].detach().float())
            assert values.dtype == torch.float32


def lie(content: bytes, was: bytes, now: bytes, method: int = zipfile.ZIP_STORED) -> bytes:
    """The archive with other bytes in its pickle."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(stream, "w", method) as changed:
        for entry in archive.infolist():
            data = archive.read(entry)
            if entry.filename.endswith("data.pkl"):
                assert was in data
                data = data.replace(was, now)
            changed.writestr(entry.filename, data)
    return stream.getvalue()


class Call:
    """Pickles as a call."""

    def __reduce__(self):
        return os.mkdir, ("made-by-a-pickle",)


ONE = {"plain": torch.zeros(200), "other": torch.zeros(10_000)}
LARGE = b"J" + struct.pack("<i", 2**31 - 1)
DAMAGED = {
    "a storage of more numbers than the file has": lie(saved(ONE, NEW), b"K\xc8", LARGE),
    "a storage of fewer": lie(saved(ONE, NEW), b"K\xc8", b"K\x07"),
    "the same in the old layout": saved(ONE, OLD).replace(b"K\xc8", LARGE),
    "a name longer than the file": saved(ONE, OLD).replace(b"X\5\0\0\0plain", b"X\xff\xff\xff\x7fplain"),
    "a sparse tensor": saved({"plain": torch.zeros(200).to_sparse()}, NEW),
    "another shape": saved({"plain": torch.zeros(201)}, NEW),
    "integers": saved({"plain": torch.zeros(200, dtype=torch.int32)}, NEW),
    "infinite numbers": saved({"plain": torch.full((200,), torch.inf)}, NEW),
    "no tensor": saved({"plain": 1}, NEW),
    "another name": saved({"other": torch.zeros(200)}, NEW),
    "a call": saved({"plain": Call()}, NEW),
    "a call in the old layout": saved({"plain": Call()}, OLD),
    "negative sizes": lie(saved(ONE, NEW), b"K\xc8", b"J\xff\xff\xff\xff"),
    "an archive without a pickle": b"PK\x05\x06" + bytes(18),
    "a compressed archive": lie(saved(ONE, NEW), b"plain", b"plain", zipfile.ZIP_DEFLATED),
    "a list": saved([1, 2], NEW),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_other_files_are_refused_and_nothing_is_run(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "w.pth"
    path.write_bytes(DAMAGED[name])
    with pytest.raises(InputError) as caught, memory_below(2**20):
        read_weights(path, {"plain": (200,)})
    assert caught.value.file == str(path)
    assert "weights_only" not in str(caught.value)
    assert [*tmp_path.iterdir()] == [path]
