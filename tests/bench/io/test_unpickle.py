"""The restricted unpickler: reads what FLAME's files hold, and refuses whatever could run code."""

import builtins
import copyreg
import io
import os
import pickle

import numpy as np
import pytest
import scipy.sparse

from headbench.bench.errors import InputError
from headbench.bench.io import unpickle
from headbench.bench.io.unpickle import read_pickle

from ...datasets.head.flame_files import chumpy_stand_in, flame_content, legacy_pickle
from ...datasets.head.toy import toy_head
from ...memory import memory_below

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


def refusal(path, content):
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_pickle(path)
    assert caught.value.file == str(path)
    return caught.value


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_reads_arrays_of_every_protocol(tmp_path, protocol):
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(ARRAYS | MATRICES | {"text": "lbs"}, protocol=protocol))
    content = read_pickle(tmp_path / "x.pkl")
    for name, expected in ARRAYS.items():
        np.testing.assert_array_equal(content[name], expected)
        assert content[name].dtype == np.asarray(expected).dtype.newbyteorder("=")
    for name, matrix in MATRICES.items():
        np.testing.assert_array_equal(content[name], matrix.toarray())
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


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_reads_chumpy_of_every_protocol(tmp_path, protocol):
    with chumpy_stand_in() as ch:
        (tmp_path / "x.pkl").write_bytes(pickle.dumps({"x": ch(np.arange(6.0))}, protocol=protocol))
    np.testing.assert_array_equal(read_pickle(tmp_path / "x.pkl")["x"], np.arange(6.0))


def test_sums_repeated_entries_as_scipy_does(tmp_path):
    matrix = scipy.sparse.coo_matrix(([1.0, 2.0, 4.0], ([0, 0, 1], [1, 1, 0])), shape=(2, 2))
    (tmp_path / "x.pkl").write_bytes(pickle.dumps({"x": matrix}))
    np.testing.assert_array_equal(read_pickle(tmp_path / "x.pkl")["x"], [[0, 3], [4, 0]])


class Call:
    """Pickles as a call."""

    def __init__(self, function, *arguments, state=None):
        self.parts = (function, arguments) if state is None else (function, arguments, state)

    def __reduce__(self):
        return self.parts


def test_an_attack_that_works_elsewhere_does_nothing_here(tmp_path):
    target = tmp_path / "created"
    stream = pickle.dumps({"x": np.zeros(3), "y": Call(os.mkdir, str(target))})
    error = refusal(tmp_path / "attack.pkl", stream)
    assert not target.exists()
    assert f"{os.mkdir.__module__}.mkdir" in error.key
    pickle.loads(stream)
    assert target.exists()  # the stream is live


ATTACKS = {
    "os.system": Call(os.system, "true"),
    "eval": Call(eval, "1"),
    "exec": Call(exec, ""),
    "getattr": Call(getattr, np.zeros(1), "tofile"),
    "import": Call(builtins.__import__, "os"),
    "open": Call(open, os.devnull),
    "numpy.load": Call(np.load, "x.npy"),
    "numpy.fromfile": Call(np.fromfile, "x"),
    "numpy.memmap": Call(np.memmap, "x"),
    "numpy.frombuffer": Call(np.frombuffer, b"1234"),
    "numpy.frompyfunc": Call(np.frompyfunc, len, 1, 1),
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


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize("name", ATTACKS)
def test_refuses(tmp_path, name, protocol):
    refusal(tmp_path / "attack.pkl", pickle.dumps({"x": ATTACKS[name]}, protocol=protocol))
    with chumpy_stand_in() as ch:
        refusal(tmp_path / "attack.pkl", pickle.dumps({"x": ch(ATTACKS[name])}, protocol=protocol))


def test_names_the_global(tmp_path):
    error = refusal(tmp_path / "attack.pkl", b"cposix\nsystem\n(S'true'\ntR.")
    assert error.key == "global posix.system"
    assert "could run code" in str(error)


ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n"
STREAMS = {
    "altered function": ARRAY + b"(dS'_call'\nS'x'\nsb.",
    "function with slots": ARRAY + b"(N(dS'_call'\nS'x'\nstb.",
    "altered class": b"cchumpy.ch\nCh\n(dS'array'\nS'x'\nsb.",
    "altered array class": b"cnumpy\nndarray\n(dS'x'\nS'x'\nsb.",
    "reconstruction of a class": ARRAY + b"(cchumpy.ch\nCh\n(I0\ntS'b'\ntR.",
    "array without a state": b"(dS'x'\n" + ARRAY + b"(cnumpy\nndarray\n(I0\ntS'b'\ntRs.",
    "chumpy without a state": b"(dS'x'\n(ichumpy.ch\nCh\ns.",
    "class as data": b"(dS'x'\ncnumpy\nndarray\ns.",
    "function as data": b"(dS'x'\n" + ARRAY + b"s.",
    "dtype as data": b"(dS'x'\ncnumpy\ndtype\n(S'f8'\ntRs.",
    "bare object": b"c__builtin__\nobject\n)R.",
    "reconstructor of a function": b"ccopy_reg\n_reconstructor\n(" + ARRAY + b"c__builtin__\nobject\nNtR.",
    "dotted name": b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93.",
    "dunder": b"\x80\x04\x8c\x05numpy\x8c\x11ndarray.__class__\x93.",
    "persistent object": b"Pname\n.",
    "out-of-band buffer": b"\x80\x05\x97.",
    "huge memo": b"\x80\x02N\x72\xff\xff\xff\xff.",
    "huge bytes": b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7fabc.",
    "pop from nothing": b"0.",
    "no pickle": b"solid mesh",
    "empty": b"",
    "list": b"(lp0\n.",
    "array at the top": pickle.dumps(np.zeros(3)),
    "numbers as names": b"(dI1\nI2\ns.",
}


@pytest.mark.parametrize("name", STREAMS)
def test_refuses_crafted_streams(tmp_path, name):
    refusal(tmp_path / "crafted.pkl", STREAMS[name])
    (tmp_path / "good.pkl").write_bytes(pickle.dumps(ARRAYS))
    np.testing.assert_array_equal(read_pickle(tmp_path / "good.pkl")["double"], ARRAYS["double"])  # unharmed


def test_no_stream_alters_a_function_that_others_use(tmp_path):
    refusal(tmp_path / "x.pkl", b"c_codecs\nencode\n(N(dS'mark'\nI1\nstb.")
    assert not hasattr(unpickle._encode, "mark")


def amplified(count: int, size: int, what: str) -> bytes:
    """A dictionary with ``count`` arrays, each made anew of the same ``size`` bytes, in a few operations each."""
    raw = {"bytes": b"\x8e" + size.to_bytes(8, "little") + bytes(size)}
    raw["text"] = b"\x8d" + size.to_bytes(8, "little") + b"a" * size
    raw["encoded"] = b"c_codecs\nencode\n(" + raw["text"] + b"tR"
    kind = b"cnumpy\ndtype\n(X\x02\0\0\0u1tR(K\x03X\x01\0\0\0<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\0tb"
    state = b"(K\x01(J" + size.to_bytes(4, "little") + b"t" + kind + b"\x89" + raw[what] + b"tq\x01"
    array = ARRAY + b"(cnumpy\nndarray\n(K\0tX\x01\0\0\0btR"
    names = [b"X\x04\0\0\0" + f"{number:04}".encode() for number in range(count)]
    whole = b"\x80\x04}" + b"X\x05\0\0\0first" + array + state + b"bs"
    return whole + b"".join(name + array + b"h\x01bs" for name in names) + b"."


TUPLES = b"(K\x01t" + b"2\x86" * 60  # a pair of a pair ..., 2^60 numbers
LONG = b"\x8b\x40\x42\x0f\0" + b"\x01" * 1_000_000
BOMBS = {
    "a huge memo": b"\x80\x02Nr\xff\xff\xff\x0f.",
    "huge bytes": b"\x80\x04\x8e\x00\x00\x00\x00\x04\0\0\0abc.",
    "many arrays of the same bytes": amplified(500, 2**20, "bytes"),
    "many arrays of the same text": amplified(500, 2**20, "text"),
    "many arrays of the same encoded text": amplified(500, 2**20, "encoded"),
    "a key of nested tuples": b"\x80\x04}" + TUPLES + b"Ns.",
    "keys of nested tuples": b"\x80\x04}(" + TUPLES + b"Nu.",
    "a set of nested tuples": b"\x80\x04\x8f(" + TUPLES + b"\x90.",
    "a frozen set of nested tuples": b"\x80\x04(" + TUPLES + b"\x91.",
    "long numbers as keys": b"\x80\x02}(" + LONG + b"q\x00N" + b"h\x00N" * 100_000 + b"u.",
    "a long shape": amplified(0, 8, "bytes").replace(
        b"(J\x08\0\0\0t", b"(" + b"J\xff\xff\xff\x7f" * 400_000 + b"t"
    ),
    "a shape of long numbers": amplified(0, 8, "bytes").replace(b"(J\x08\0\0\0t", b"(" + LONG + b"t"),
    "a long name": b"c" + b"a" * 3_000_000 + b"\nb\n.",
}


@pytest.mark.parametrize("what", ["bytes", "text", "encoded"])
def test_one_array_of_the_bombs_below_is_read(tmp_path, what):
    (tmp_path / "x.pkl").write_bytes(amplified(0, 100, what))
    assert read_pickle(tmp_path / "x.pkl")["first"].shape == (100,)


@pytest.mark.parametrize("name", BOMBS)
def test_memory_and_message_are_bounded_by_the_file(tmp_path, name):
    allowed = 150_000_000 if len(BOMBS[name]) > 100 else 10_000_000
    with memory_below(4 * len(BOMBS[name]) + allowed):
        error = refusal(tmp_path / "bomb.pkl", BOMBS[name])
    assert len(str(error)) < 3000


def test_matrices_that_are_named_often_are_made_once(tmp_path):
    zeros = scipy.sparse.csr_matrix((2, 1_500_000))
    (tmp_path / "x.pkl").write_bytes(pickle.dumps({str(number): zeros for number in range(100)}))
    assert len({id(matrix) for matrix in read_pickle(tmp_path / "x.pkl").values()}) == 1
    refusal(tmp_path / "y.pkl", pickle.dumps({str(number): zeros.copy() for number in range(3)}))


def test_refuses_registered_extensions(tmp_path):
    copyreg.add_extension("os", "getcwd", 0x7FFF0001)
    try:
        stream = pickle.dumps({"x": Call(os.getcwd)}, protocol=2)
        refusal(tmp_path / "x.pkl", b"\x80\x02}U\x01x\x84\x01\x00\xff\x7f)Rs.")
        refusal(tmp_path / "y.pkl", stream)
    finally:
        copyreg.remove_extension("os", "getcwd", 0x7FFF0001)


def sparse_with(**changes):
    matrix = MATRICES["csc"].copy()
    state = dict(vars(matrix)) | changes
    stream = io.BytesIO()

    class Pickler(pickle._Pickler):  # type: ignore[name-defined, misc]
        def reducer_override(self, obj):
            if obj is matrix:
                return copyreg.__newobj__, (type(matrix),), state  # type: ignore[attr-defined]
            return NotImplemented

    Pickler(stream, protocol=2).dump({"x": matrix})
    return stream.getvalue()


def test_sparse_matrices_are_checked(tmp_path):
    (tmp_path / "x.pkl").write_bytes(sparse_with())
    np.testing.assert_array_equal(read_pickle(tmp_path / "x.pkl")["x"], MATRICES["csc"].toarray())
    matrix = MATRICES["csc"]
    bad: dict[str, dict[str, object]] = {
        "huge": {"_shape": (10**9, 40)},
        "negative": {"_shape": (-5, 40)},
        "rows": {"_shape": (2, 40)},
        "columns": {"_shape": (5, 39)},
        "cube": {"_shape": (5, 8, 5)},
        "values": {"data": matrix.data[:-1]},
        "indices": {"indices": matrix.indices + 5},
        "pointers": {"indptr": matrix.indptr[::-1].copy()},
        "unordered": {"indptr": matrix.indptr[[0, *range(39, 0, -1), 40]]},
        "text": {"data": "abc"},
        "none": {"indices": None},
    }
    for name, change in bad.items():
        refusal(tmp_path / f"{name}.pkl", sparse_with(**change))


def test_arrays_have_the_bytes_they_declare(tmp_path):
    good = pickle.dumps({"x": np.arange(3.0)}, protocol=2)
    shape = b"K\x03\x85"
    assert good.count(shape) == 1
    for other in (b"K\x04\x85", b"J\xff\xff\xff\xff\x85", b"J\xff\xff\xff\x7f\x85"):  # 4, -1, 2^31 - 1
        refusal(tmp_path / "x.pkl", good.replace(shape, other))
