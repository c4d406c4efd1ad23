"""The restricted unpickler: reads what FLAME's and trackers' files hold, and refuses whatever could run code."""

import copyreg
import io
import os
import pickle

import numpy as np
import pytest
import scipy.sparse
import torch

from headbench.bench.errors import InputError
from headbench.bench.io.arrays import read_pickle, read_saved

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
