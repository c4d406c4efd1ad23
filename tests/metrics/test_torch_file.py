"""Files of ``torch.save`` read without torch: equal to what torch reads, and never more than is in the file."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
import torch

from headbench.bench.errors import InputError
from headbench.metrics.torch_file import read_weights

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
            np.testing.assert_array_equal(values, state[name].detach().numpy())
            assert values.dtype == state[name].detach().numpy().dtype


def lie(content: bytes, was: bytes, now: bytes) -> bytes:
    """The archive with other bytes in its pickle."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(stream, "w") as changed:
        for entry in archive.infolist():
            data = archive.read(entry)
            if entry.filename.endswith("data.pkl"):
                assert was in data
                data = data.replace(was, now)
            changed.writestr(entry.filename, data)
    return stream.getvalue()


ONE = {"plain": torch.zeros(200)}
LARGE = b"J" + struct.pack("<i", 2**31 - 1)
DAMAGED = {
    "a storage of more numbers than the file has": lie(saved(ONE, NEW), b"K\xc8", LARGE),
    "a storage of fewer": lie(saved(ONE, NEW), b"K\xc8", b"K\x07"),
    "the same in the old layout": saved(ONE, OLD).replace(b"K\xc8", LARGE),
    "a stride of zero": saved({"plain": torch.zeros(1).expand(200)}, NEW),
    "negative sizes": lie(saved(ONE, NEW), b"K\xc8", b"J\xff\xff\xff\xff"),
    "an archive without a pickle": b"PK\x05\x06" + bytes(18),
    "a compressed archive": b"",  # made in the test
    "a list": saved([1, 2], NEW),
    "only a part": saved(ONE, OLD)[:-100],
    "text": b"no weights",
}


@pytest.mark.parametrize("name", DAMAGED)
def test_what_a_file_declares_is_compared_with_what_it_has(tmp_path, name):
    path = tmp_path / "w.pth"
    path.write_bytes(DAMAGED[name])
    if name == "a compressed archive":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("w/data.pkl", bytes(10**8))
    tracemalloc.start()
    with pytest.raises(InputError) as caught:
        read_weights(path, {"plain": (200,)})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20
    assert caught.value.file == str(path)


@pytest.mark.parametrize("layout", [OLD, NEW])
def test_damage_is_refused_or_gives_numbers(tmp_path, layout):
    path, whole, rng = tmp_path / "w.pth", saved(STATE, layout), np.random.default_rng(0)
    for _ in range(300):
        damaged = bytearray(whole)
        for position in rng.integers(0, len(whole), 3):
            damaged[position] = rng.integers(256)
        path.write_bytes(damaged[: rng.choice([len(whole), rng.integers(len(whole))])])
        try:
            found = read_weights(path, WANTED)
        except InputError:
            continue
        assert all(values.shape == WANTED[name] for name, values in found.items())
