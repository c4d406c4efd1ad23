"""Arrays from files: what is read as it was written, and what is refused."""

from __future__ import annotations

import copyreg
import io
import os
import pickle
import zipfile

import numpy as np
import pytest
import scipy.sparse
import torch

from headbench.bench.errors import InputError
from headbench.bench.io.arrays import TEXT, Member, read_arrays, read_npy, read_npz, read_pickle, read_saved

from ...datasets.head.flame_files import chumpy_stand_in, flame_content, legacy_pickle
from ...datasets.head.toy import toy_head

RNG = np.random.default_rng(0)
ARRAYS = {
    "double": RNG.normal(size=(4, 3, 2)),
    "single": RNG.normal(size=5).astype(np.float32),
    "unsigned": np.arange(6, dtype=np.uint32).reshape(2, 3),
    "big endian": RNG.normal(size=(3, 2)).astype(">f8"),
    "fortran": np.asfortranarray(RNG.normal(size=(4, 5))),
    "boolean": np.array([True, False]),
    "empty": np.zeros((0, 3)),
    "scalar": np.float64(2.5),
}
MATRICES = {
    layout: scipy.sparse.random(5, 40, density=0.2, random_state=1).asformat(layout)
    for layout in ("csc", "csr", "coo")
}


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_reads_arrays_of_every_protocol(tmp_path, protocol):
    with chumpy_stand_in() as ch:
        held = ARRAYS | MATRICES | {"text": "lbs", "chumpy": ch(np.arange(6.0))}
        (tmp_path / "x.pkl").write_bytes(pickle.dumps(held, protocol=protocol))
    content = read_pickle(tmp_path / "x.pkl")
    for name, expected in ARRAYS.items():
        np.testing.assert_array_equal(content[name], expected)
        assert content[name].dtype == np.asarray(expected).dtype.newbyteorder("=")
        assert content[name].flags.writeable
    for name, matrix in MATRICES.items():
        np.testing.assert_array_equal(content[name], matrix.toarray())
    np.testing.assert_array_equal(content["chumpy"], np.arange(6.0))
    assert content["text"] == "lbs"


def test_reads_what_python_2_wrote(tmp_path):
    head = toy_head(16)
    source = flame_content(head) | MATRICES
    with chumpy_stand_in() as ch:
        stream = legacy_pickle(source | {"v_template": ch(head.template), "shapedirs": ch(head.shape_basis)})
    for name in (b"chumpy.ch\nCh", b"numpy.core.multiarray\n_reconstruct", b"scipy.sparse.csc\ncsc_matrix"):
        assert name in stream
    assert b"numpy._core" not in stream
    (tmp_path / "x.pkl").write_bytes(stream)
    content = read_pickle(tmp_path / "x.pkl")
    np.testing.assert_array_equal(content["v_template"], head.template)
    np.testing.assert_array_equal(content["shapedirs"], head.shape_basis)
    np.testing.assert_array_equal(content["J_regressor"], head.joint_regressor)
    np.testing.assert_array_equal(content["f"], head.faces)
    np.testing.assert_array_equal(content["coo"], MATRICES["coo"].toarray())


class Call:
    """Pickles as a call."""

    def __init__(self, function, *arguments, state=None):
        self.parts = (function, arguments) if state is None else (function, arguments, state)

    def __reduce__(self):
        return self.parts


def test_an_attack_that_works_elsewhere_does_nothing_here(tmp_path):
    target, path = tmp_path / "created", tmp_path / "attack.pkl"
    path.write_bytes(pickle.dumps({"x": np.zeros(3), "y": Call(os.mkdir, str(target))}))
    with pytest.raises(InputError, match=rf"global {os.mkdir.__module__}\.mkdir.*could run code"):
        read_pickle(path)
    assert not target.exists()
    pickle.loads(path.read_bytes())
    assert target.exists()  # the stream is live


ATTACKS = {
    "os.system": Call(os.system, "true"),
    "eval": Call(eval, "1"),
    "getattr": Call(getattr, np.zeros(1), "tofile"),
    "numpy.load": Call(np.load, "x.npy"),
    "scipy function": Call(scipy.sparse.load_npz, "x"),
    "other sparse": scipy.sparse.eye(3, format="dok"),
    "object array": np.array([{}], dtype=object),
    "text array": np.array(["abc"]),
    "record array": np.zeros(2, dtype=[("a", "f8")]),
    "date array": np.zeros(2, dtype="M8[s]"),
    "class": dict,
    "nested call": Call(np.dtype, Call(os.getcwd)),
    "call in a state": Call(np.dtype, "f8", state=(3, Call(os.getcwd), None, None, None, -1, -1, 0)),
    "call in a list": [1, [2, (3, Call(os.getcwd))]],
}
ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n"
REFUSED = {
    **{
        f"{name} {protocol}": pickle.dumps({"x": attack}, protocol=protocol)
        for name, attack in ATTACKS.items()
        for protocol in (0, 5)
    },
    "altered function": ARRAY + b"(dS'_call'\nS'x'\nsb.",
    "altered class": b"cchumpy.ch\nCh\n(dS'array'\nS'x'\nsb.",
    "altered codec": b"c_codecs\nencode\n(N(dS'mark'\nI1\nstb.",
    "chumpy without a state": b"(dS'x'\n(ichumpy.ch\nCh\ns.",
    "function as data": b"(dS'x'\n" + ARRAY + b"s.",
    "dtype as data": b"(dS'x'\ncnumpy\ndtype\n(S'f8'\ntRs.",
    "bare object": b"c__builtin__\nobject\n)R.",
    "dotted name": b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93.",
    "persistent object": b"Pname\n.",
    "out-of-band buffer": b"\x80\x05\x97.",
    "no pickle": b"solid mesh",
    "empty": b"",
    "truncated": pickle.dumps(ARRAYS)[:-20],
    "array at the top": pickle.dumps(np.zeros(3)),
    "numbers as names": b"(dI1\nI2\ns.",
    "fewer bytes than the shape": pickle.dumps({"x": np.arange(3.0)}, protocol=2).replace(
        b"K\x03\x85", b"K\x04\x85"
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refuses_with_the_file_and_leaves_the_next_one_unharmed(tmp_path, name):
    (tmp_path / "x.pkl").write_bytes(REFUSED[name])
    with pytest.raises(InputError) as caught:
        read_pickle(tmp_path / "x.pkl")
    assert caught.value.file == str(tmp_path / "x.pkl")
    (tmp_path / "good.pkl").write_bytes(pickle.dumps(ARRAYS | MATRICES))
    np.testing.assert_array_equal(read_pickle(tmp_path / "good.pkl")["double"], ARRAYS["double"])


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"_shape": (2, 40)},
        {"_shape": (5, 39)},
        {"_shape": (5, 8, 5)},
        {"data": MATRICES["csc"].data[:-1]},
        {"indices": MATRICES["csc"].indices + 5},
        {"indptr": MATRICES["csc"].indptr[::-1].copy()},
        {"data": "abc"},
        {"indices": None},
    ],
    ids=str,
)
def test_sparse_matrices_are_checked(tmp_path, change):
    matrix, path, stream = MATRICES["csc"].copy(), tmp_path / "x.pkl", io.BytesIO()

    class Pickler(pickle._Pickler):  # type: ignore[name-defined, misc]
        def reducer_override(self, obj):
            if obj is matrix:
                return copyreg.__newobj__, (type(matrix),), dict(vars(matrix)) | change  # type: ignore[attr-defined]
            return NotImplemented

    Pickler(stream, protocol=2).dump({"x": matrix})
    path.write_bytes(stream.getvalue())
    if change:
        with pytest.raises(InputError, match=r"x\.pkl"):
            read_pickle(path)
    else:
        np.testing.assert_array_equal(read_pickle(path)["x"], matrix.toarray())


SINGLE = np.arange(6, dtype=np.float32).reshape(1, 6)
CONTENT = {
    "flame": {"exp": SINGLE},
    "size": np.array([512, 512]),
    "frame": "00012",
    "scalar": np.float64(2.5),
}


def test_reads_dictionaries_inside_a_dictionary_of_torch(tmp_path):
    torch.save(CONTENT, tmp_path / "x.frame")
    found = read_saved(tmp_path / "x.frame")
    np.testing.assert_array_equal(found["flame"]["exp"], SINGLE)
    assert found["flame"]["exp"].dtype == np.float32
    assert found["size"].tolist() == [512, 512]
    assert (found["frame"], float(found["scalar"])) == ("00012", 2.5)


@pytest.mark.parametrize("content", [{"x": torch.zeros(3)}, {"x": torch.nn.Linear(1, 1)}, [SINGLE]], ids=type)
def test_other_files_of_torch_are_refused(tmp_path, content):
    torch.save(content, tmp_path / "x.frame")
    with pytest.raises(InputError, match=r"x\.frame"):
        read_saved(tmp_path / "x.frame")


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
