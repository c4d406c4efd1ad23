"""Files of torch.save with dictionaries of arrays: read as data, and nothing else is."""

import zipfile

import numpy as np
import pytest
import torch

from headbench.bench.errors import InputError
from headbench.bench.io.saved import read_saved

SINGLE = np.arange(6, dtype=np.float32).reshape(1, 6)
CONTENT = {
    "flame": {"exp": SINGLE, "again": SINGLE},
    "size": np.array([512, 512]),
    "frame": "00012",
    "step": 7,
    "scalar": np.float64(2.5),
}


def test_reads_dictionaries_inside_a_dictionary(tmp_path):
    torch.save(CONTENT, tmp_path / "x.frame")
    found = read_saved(tmp_path / "x.frame")
    np.testing.assert_array_equal(found["flame"]["exp"], SINGLE)
    assert found["flame"]["exp"].dtype == np.float32
    assert found["flame"]["again"] is found["flame"]["exp"]
    assert found["size"].tolist() == [512, 512]
    assert (found["frame"], found["step"], float(found["scalar"])) == ("00012", 7, 2.5)


def zipped(**members):
    def write(path):
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in members.items():
                archive.writestr(f"{name}/data.pkl", content)

    return write


REFUSED = {
    "a tensor": (lambda path: torch.save({"x": torch.zeros(3)}, path), "torch._utils._rebuild_tensor"),
    "a module": (lambda path: torch.save({"x": torch.nn.Linear(1, 1)}, path), "could run code"),
    "a list": (lambda path: torch.save([SINGLE], path), "a list"),
    "the old layout": (
        lambda path: torch.save(CONTENT, path, _use_new_zipfile_serialization=False),
        "zip",
    ),
    "no pickle": (zipped(), "one member data.pkl"),
    "two pickles": (zipped(a=b"", b=b""), "one member data.pkl"),
    "a damaged pickle": (zipped(a=b"\x80\x02}q"), "torch.save"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_anything_else_is_refused(tmp_path, kind):
    write, words = REFUSED[kind]
    write(tmp_path / "x.frame")
    with pytest.raises(InputError, match=words):
        read_saved(tmp_path / "x.frame")
