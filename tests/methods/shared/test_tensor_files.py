"""Tensors of safetensors files: what is no such file, or holds what no avatar can, is refused."""

import pickle
import struct

import numpy as np
import pytest
import torch
from safetensors.torch import save

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.bench.io.arrays import Member
from headbench.methods.shared.loop import CHECKPOINT, Fit, train
from headbench.methods.shared.tensor_files import (
    LARGEST_LOGIT,
    check_sizes,
    check_tensors,
    load_checkpoint,
    read_names,
    read_ply,
    read_safetensors,
    save_checkpoint,
    write_ply,
)

TABLE = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)


def test_columns_come_back_by_name_in_any_order(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, ("x", "y", "z"), TABLE)
    np.testing.assert_array_equal(read_ply(path, ("z", "x")), TABLE[:, [2, 0]])


def test_another_program_reads_the_positions(tmp_path):
    pymeshlab = pytest.importorskip("pymeshlab")
    path = tmp_path / "a.ply"
    write_ply(path, ("x", "y", "z"), TABLE)
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(path))
    np.testing.assert_allclose(meshes.current_mesh().vertex_matrix(), TABLE, rtol=1e-6)


def test_columns_of_other_types_and_line_ends_are_read(tmp_path):
    """As other programs rewrite such files; the row is packed by hand."""
    header = b"ply\r\nformat binary_little_endian 1.0\r\ncomment by hand\r\nelement vertex 2\r\n"
    header += b"property double x\r\nproperty uchar red\r\nproperty int binding_0\r\nend_header\r\n"
    path = tmp_path / "a.ply"
    path.write_bytes(header + struct.pack("<dBi", 1.5, 7, 16777215) + struct.pack("<dBi", -2.25, 255, 3))
    np.testing.assert_array_equal(read_ply(path, ("binding_0", "x")), [[16777215, 1.5], [3, -2.25]])
    assert read_names(path) == ("x", "red", "binding_0")


HEADER = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n"


OTHER = [
    *(b"", b"ply\nnothing", HEADER.encode() + b"\0" * 3, HEADER.encode() + b"\0" * 8),
    *(
        HEADER.replace(*change).encode() + b"\0" * size
        for *change, size in (
            ("binary_little_endian", "ascii", 4),
            ("float x", "list uchar int x", 4),
            ("float x", "half x", 2),
            ("float x\n", "float x\nproperty float x\n", 8),
            ("property float x\n", "", 0),
            ("float x", "float y", 4),
            ("vertex 1", "vertex 99999999999", 4),
        )
    ),
    HEADER.replace("float x", "double x").encode() + np.float64(1e300).tobytes(),
    HEADER.encode() + np.float32(np.nan).tobytes(),
]


@pytest.mark.parametrize("content", [*OTHER, None])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "bad.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match="bad.ply"):
        read_ply(path, ("x",))


def test_infinite_logits_of_opacities_are_cut(tmp_path):
    table = TABLE[:, :2].copy()
    table[:3, 1] = np.inf, -np.inf, 3
    write_ply(tmp_path / "a.ply", ("x", "opacity"), table)
    found = read_ply(tmp_path / "a.ply", ("x", "opacity"))
    assert found[:3, 1].tolist() == [LARGEST_LOGIT, -LARGEST_LOGIT, 3]
    assert 1 / (1 + np.exp(-np.float32(LARGEST_LOGIT))) == 1
    for value, column in ((np.nan, 1), (np.inf, 0)):
        table[4, column] = value
        write_ply(tmp_path / "a.ply", ("x", "opacity"), table)
        with pytest.raises(
            InputError, match=f"vertex data, {('x', 'opacity')[column]}: .* {value} in vertex 4"
        ):
            read_ply(tmp_path / "a.ply", ("x", "opacity"))
        table[4, column] = 0


def test_what_was_saved_comes_back(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    shared = torch.randn(4, 3)
    state = {
        "iteration": 3,
        "deep": {"x": shared, "row": shared[1], "turned": shared.T, "name": "a", 7: None},
        "list": [1.5, 2, float("inf"), True, (1, [torch.zeros(0, 2), torch.tensor(3, dtype=torch.uint8)])],
        "small": torch.ones(2, dtype=torch.bfloat16),
    }
    save_checkpoint(path, "run", state)
    found = load_checkpoint(path, "run", "cpu")
    assert str(found) == str(state)
    assert all(torch.equal(found["deep"][name], state["deep"][name]) for name in ("x", "row", "turned"))
    assert found["deep"]["turned"].stride() == state["deep"]["turned"].stride()
    assert found["list"][4][1][1].dtype == torch.uint8


def test_no_file_is_no_checkpoint_and_another_runs_is_refused(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    assert load_checkpoint(path, "run", "cpu") is None
    save_checkpoint(path, "one", {})
    with pytest.raises(InputError, match="another run"):
        load_checkpoint(path, "two", "cpu")


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    class Touches:
        def __reduce__(self):
            return (open, (str(witness), "w"))

    path, witness = tmp_path / "checkpoint.safetensors", tmp_path / "witness"
    for write in (pickle.dump, torch.save):
        with path.open("wb") as stream:
            write({"layout": 1, "run": "run", "state": Touches()}, stream)
        with pytest.raises(InputError):
            load_checkpoint(path, "run", "cpu")
    assert not witness.exists()


def test_damage_anywhere_is_found(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, "run", {"x": torch.randn(10), "name": [1, "a", None]})
    whole = path.read_bytes()
    flipped = (whole[:i] + bytes([whole[i] ^ 1]) + whole[i + 1 :] for i in range(0, len(whole), 3))
    for content in (whole[:200], b"", whole + b"\0", *flipped):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"[Dd]elete it"):
            load_checkpoint(path, "run", "cpu")


@pytest.mark.parametrize(
    "state",
    [
        {},
        {"iteration": 1, "total": 2, "seconds": None},
        {"iteration": 1, "total": 2, "seconds": 0.0, "trainable": []},
    ],
)
def test_a_state_that_is_none_of_the_method_is_refused(tmp_path, state):
    class Method:
        def begin(self, timeline):
            pass

        def load_state(self, state):
            state["means"]

    save_checkpoint(tmp_path / CHECKPOINT, "run", state)
    fit = Fit(None, tmp_path, Budget(iterations=2), "cpu", 0, no_progress, "run")
    with pytest.raises(InputError, match="the state of this method"):
        train(Method(), lambda iteration: 0, fit, published_length=1, checkpoint_every_s=1.0)


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, "run", {"x": 1})
    with pytest.raises((AttributeError, TypeError, pickle.PicklingError, RuntimeError)):
        save_checkpoint(path, "run", {"x": lambda: None})
    assert load_checkpoint(path, "run", "cpu") == {"x": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.safetensors"]


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
