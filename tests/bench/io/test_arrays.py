"""Arrays from files: what is read as it was written, and what is refused."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.io.arrays import TEXT, Member, read_arrays, read_npy, read_npz

KEPT = {
    "floats": np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4),
    "columns first": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "big-endian": np.arange(5, dtype=">i4"),
    "flags": np.array([True, False]),
    "text": np.array("a name"),
    "no text": np.array(""),
    "texts": np.array(["one", "two"]),
    "empty": np.zeros((0, 3), np.float16),
    "scalar": np.array(3),
}


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_what_numpy_writes_is_read_in_native_order(tmp_path, save):
    path = tmp_path / "a.npz"
    save(path, **KEPT)
    found = read_npz(path)
    assert [*found] == [*KEPT]
    for name, values in KEPT.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype.newbyteorder("=")
        assert found[name].flags.writeable
        np.save(tmp_path / "a.npy", values)
        np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), values)


def npy(values) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values, allow_pickle=True)
    return stream.getvalue()


DAMAGED = {
    "no npy": b"anything",
    "empty": b"",
    "objects": npy(np.array([{}], dtype=object)),
    "records": npy(np.zeros(2, [("x", "f4")])),
    "complex": npy(np.zeros(2, complex)),
    "dates": npy(np.zeros(2, "M8[s]")),
    "bytes": npy(np.zeros(2, "S3")),
    "short": npy(np.zeros(100))[:-1],
    "another version": b"\x93NUMPY\x09\x00" + npy(np.zeros(1))[8:],
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_file_is_refused(tmp_path, name):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("values.npy", DAMAGED[name])
    (tmp_path / "a.npy").write_bytes(DAMAGED[name])
    for file, read in (("a.npz", read_npz), ("a.npy", read_npy), ("a.npy", read_npz), ("a.npz", read_npy)):
        with pytest.raises(InputError) as caught:
            read(tmp_path / file)
        assert caught.value.file == str(tmp_path / file)


MEMBERS = {
    "points": Member("f", ("V", 3), most=10),
    "weights": Member("f", ("V",), dtype="f4"),
    "triangles": Member("iu", (None, 3), most=3, least=0),
    "name": TEXT,
    "extra": Member("f", (2,), optional=True),
}
GOOD = {
    "points": np.ones((4, 3)),
    "weights": np.ones(4, np.float32),
    "triangles": np.zeros((7, 3), np.int32),
    "name": np.array("x"),
    "other": np.zeros(1),
}


def test_arrays_that_are_as_described_are_returned(tmp_path):
    np.savez(tmp_path / "a.npz", **GOOD)
    assert [*read_arrays(tmp_path / "a.npz", MEMBERS, {"V": 4})] == [*GOOD]


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("points", None, "an array of that name"),
        ("points", np.ones((4, 2)), "shape (V, 3)"),
        ("points", np.ones((4, 3), np.int64), "floating-point numbers"),
        ("points", np.full((4, 3), np.nan), "finite numbers"),
        ("points", np.full((4, 3), -11.0), "numbers from -10 to 10"),
        ("weights", np.ones(4), "f4"),
        ("weights", np.ones(5, np.float32), "shape (4,)"),
        ("triangles", np.zeros((7, 3)), "integers"),
        ("triangles", np.full((7, 3), 4), "numbers from 0 to 3"),
        ("name", np.array(1), "text"),
        ("extra", np.zeros(3), "shape (2,)"),
    ],
)
def test_an_array_that_is_not_as_described_is_refused(tmp_path, name, value, expected):
    content = {key: array for key, array in {**GOOD, name: value}.items() if array is not None}
    np.savez(tmp_path / "a.npz", **content)
    with pytest.raises(InputError) as caught:
        read_arrays(tmp_path / "a.npz", MEMBERS)
    assert (caught.value.key, caught.value.expected) == (name, expected)
