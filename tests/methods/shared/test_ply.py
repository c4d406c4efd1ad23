"""PLY reading and writing."""

import struct

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.methods.shared.tensor_files import LARGEST_LOGIT, read_names, read_ply, write_ply

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
