"""Arrays from files: what is read as it was written, and what is refused before it costs anything."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.io import arrays
from headbench.bench.io.arrays import TEXT, Member, read_arrays, read_npy, read_npz

from ...memory import memory_below

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


def header(text: str, data: bytes = b"") -> bytes:
    line = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(line).to_bytes(2, "little") + line + data


def described(descr: str, shape: str, data: bytes = b"") -> bytes:
    return header(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}", data)


DAMAGED = {
    "no npy": b"anything",
    "empty": b"",
    "objects": npy(np.array([{}], dtype=object)),
    "records": npy(np.zeros(2, [("x", "f4")])),
    "subarrays": described("('<f4', (2,))", "(1,)", bytes(8)),
    "complex": npy(np.zeros(2, complex)),
    "long doubles": npy(np.zeros(2, np.longdouble)),
    "dates": npy(np.zeros(2, "M8[s]")),
    "bytes": npy(np.zeros(2, "S3")),
    "short": npy(np.zeros(100))[:-1],
    "long": npy(np.zeros(100)) + b"\0",
    "huge": described("'<f8'", "(4000000000000,)"),
    "huge and empty": described("'<f8'", f"({2**62}, {2**62}, 0)"),
    "negative": described("'<f8'", "(-1, -1)", bytes(8)),
    "nested header": header("[" * 115),
    "no characters": described("'<U1'", "(1,)", b"\xff\xff\xff\x7f"),
    "half a surrogate pair": described("'<U1'", "(1,)", b"\x00\xd8\x00\x00"),
    "another version": b"\x93NUMPY\x09\x00" + npy(np.zeros(1))[8:],
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_member_is_refused(tmp_path, name):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("values.npy", DAMAGED[name])
    with pytest.raises(InputError) as caught:
        read_npz(tmp_path / "a.npz")
    assert len(str(caught.value)) < 1000
    (tmp_path / "a.npy").write_bytes(DAMAGED[name])
    with pytest.raises(InputError):
        read_npy(tmp_path / "a.npy")


def archive_of(path, *names, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name in names:
            archive.writestr(name, npy(np.zeros(3)))


ARCHIVES = {
    "a member that is no npy": lambda path: archive_of(path, "values.txt"),
    "two of one name": lambda path: archive_of(path, "values.npy", "values.npy"),
    "a slow compression": lambda path: archive_of(path, "values.npy", method=zipfile.ZIP_LZMA),
    "too many members": lambda path: archive_of(path, *(f"{i}.npy" for i in range(arrays.MAX_MEMBERS + 1))),
}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("name", ARCHIVES)
def test_another_file_than_an_npz_is_refused(tmp_path, name):
    ARCHIVES[name](tmp_path / "a.npz")
    with pytest.raises(InputError) as caught:
        read_npz(tmp_path / "a.npz")
    assert caught.value.file == str(tmp_path / "a.npz")


@pytest.mark.parametrize("lie", [False, True])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, monkeypatch, lie):
    monkeypatch.setattr(arrays, "MOST_BYTES", 2**20)
    path = tmp_path / "zeros.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as stream:
        stream.write(described("'<f8'", f"({2**22},)"))
        for _ in range(32):
            stream.write(bytes(2**20))
    content = path.read_bytes()
    if lie:  # the directory names a small size
        place = content.rindex(b"PK\x01\x02") + 24
        content = content[:place] + (1000).to_bytes(4, "little") + content[place + 4 :]
        path.write_bytes(content)
    with pytest.raises(InputError), memory_below(2**20):
        read_npz(path)


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
        ("points", np.ones(4), "shape (V, 3)"),
        ("points", np.ones((4, 3), np.int64), "floating-point numbers"),
        ("points", np.full((4, 3), np.nan), "finite numbers"),
        ("points", np.full((4, 3), -11.0), "numbers from -10 to 10"),
        ("weights", np.ones(4), "f4"),
        ("weights", np.ones(5, np.float32), "shape (4,)"),
        ("weights", np.full(4, np.inf, np.float32), "finite numbers"),
        ("triangles", np.zeros((7, 3)), "integers"),
        ("triangles", np.full((7, 3), -1), "numbers from 0 to 3"),
        ("triangles", np.full((7, 3), 4), "numbers from 0 to 3"),
        ("name", np.array(["x"]), "shape ()"),
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
