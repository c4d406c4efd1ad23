"""GaussianAvatars' files, written by hand, as avatars."""

import struct

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.methods.ga.method import GA
from headbench.methods.gaussian_ply.command import ImportGASettings, import_ga
from headbench.methods.shared.subject_mesh import SubjectMesh

from ...datasets.tiny_capture import write_tiny_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_tiny_capture(tmp_path_factory.mktemp("import")).union


def ga_file(path, rows, rest=45, binding="float"):
    """A file in GaussianAvatars' own order of columns; each row a dict of what is not zero."""
    names = [*("x", "y", "z", "nx", "ny", "nz"), *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(rest)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in names]
    header += [f"property {binding} binding_0", "end_header", ""]
    body = b""
    for row in rows:
        body += struct.pack(f"<{len(names)}f", *(row.get(name, 0.0) for name in names))
        body += struct.pack({"float": "<f", "int": "<i"}[binding], row["binding_0"])
    path.write_bytes("\n".join(header).encode() + body)
    return path


ROWS = [
    {"x": 0.25, "f_dc_0": 1.0, "f_rest_0": 0.5, "opacity": 2.0, "scale_0": -1.0, "rot_0": 2.0}
    | {"binding_0": 3},
    {"z": -0.5, "f_dc_2": -0.5, "opacity": -1.0, "scale_2": -2.0, "rot_1": 1.0, "binding_0": 0},
]


@pytest.mark.parametrize(
    ("rest", "binding"), [(45, "float"), (45, "int"), (24, "float"), (9, "float"), (0, "float")]
)
def test_a_file_made_by_hand_becomes_an_avatar(capture, tmp_path, rest, binding):
    ply = ga_file(tmp_path / "in.ply", ROWS, rest, binding)
    findings = imported(capture, tmp_path / "out", ply)
    assert findings.data["splats"] == findings.data["triangles"] == 2
    clip = read_capture(capture)
    avatar = GA().load(tmp_path / "out", device="cpu")
    pose = clip.poses[clip.timesteps("train")[0]]
    splats = avatar.splats(pose)
    # The first splat by GaussianAvatars' definition: mean' = k R mean + T on triangle 3.
    mesh = SubjectMesh(clip.head, clip.shape, clip.static_offset, "cpu")
    corners = mesh.posed(mesh.arguments([pose])).numpy().astype(float)[clip.head.faces[3]]
    a0 = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
    a1 = np.cross(a0, corners[2] - corners[0])
    a1 /= np.linalg.norm(a1)
    a2 = -np.cross(a1, a0)
    size = 0.5 * (np.linalg.norm(corners[1] - corners[0]) + abs(a2 @ (corners[2] - corners[0])))
    np.testing.assert_allclose(splats.means[0], size * 0.25 * a0 + corners.mean(0), atol=1e-6)
    np.testing.assert_allclose(splats.scales[0], size * np.exp([-1, 0, 0]), rtol=1e-5)
    np.testing.assert_allclose(splats.opacities, 1 / (1 + np.exp([-2.0, 1.0])), rtol=1e-5)
    dc, harmonics = avatar.harmonics()
    np.testing.assert_array_equal(dc, [[1, 0, 0], [0, 0, -0.5]])
    assert harmonics.shape == (2, 3, 15)
    assert float(harmonics[0, 0, 0]) == (0.5 if rest else 0.0)
    assert harmonics.count_nonzero() == (1 if rest else 0)
    key = clip.splits["train"][0]
    assert np.isfinite(avatar.render(clip.cameras[key.camera], pose).rgb).all()


def imported(capture, out, ply):
    return import_ga(ImportGASettings(str(ply), capture=str(capture), out=str(out)))


@pytest.mark.parametrize(
    ("change", "rest", "says"),
    [({}, 12, "f_rest"), ({"binding_0": -1}, 45, "binding_0"), ({"binding_0": 10**6}, 45, "binding_0")],
)
def test_what_is_of_no_degree_or_on_no_triangle_is_refused(capture, tmp_path, change, rest, says):
    ply = ga_file(tmp_path / "in.ply", [{**ROWS[0], **change}], rest)
    with pytest.raises(InputError, match=says):
        imported(capture, tmp_path / "out", ply)
    assert not (tmp_path / "out").exists()


def test_a_folder_in_use_is_left_alone_an_own_one_is_continued(capture, tmp_path):
    ply, other = (
        ga_file(tmp_path / "in.ply", ROWS),
        ga_file(tmp_path / "o.ply", [{**ROWS[0], "x": 0.5}, ROWS[1]]),
    )
    # The second as after a kill behind the last file.
    assert imported(capture, tmp_path / "out", ply) == imported(capture, tmp_path / "out", ply)
    for folder, file in ((tmp_path, ply), (tmp_path / "out", other)):
        with pytest.raises(InputError, match="empty folder"):
            imported(capture, folder, file)
