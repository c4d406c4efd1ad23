"""GaussianAvatars' files, written by hand, as avatars."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.engine.stored import load_avatar
from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import save_head
from headbench.methods.avatars.import_ga import import_avatar
from headbench.methods.avatars.settings import ImportGASettings
from headbench.methods.ga.method import GA
from headbench.methods.shared.surface_points import SubjectMesh

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
    avatar = load_avatar(tmp_path / "out")
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
    dc, harmonics = avatar.harmonics(pose)
    np.testing.assert_array_equal(dc, [[1, 0, 0], [0, 0, -0.5]])
    assert harmonics.shape == (2, 3, 15)
    assert float(harmonics[0, 0, 0]) == (0.5 if rest else 0.0)
    assert np.count_nonzero(harmonics) == (1 if rest else 0)
    key = clip.splits["train"][0]
    assert np.isfinite(avatar.render(clip.cameras[key.camera], pose).rgb).all()


def imported(capture, out, ply):
    return import_avatar(ImportGASettings(str(ply), capture=str(capture), out=str(out)))


@pytest.mark.parametrize(
    ("change", "rest", "says"),
    [({}, 12, "f_rest"), ({"binding_0": -1}, 45, "binding"), ({"binding_0": 10**6}, 45, "binding")],
)
def test_what_is_of_no_degree_or_on_no_triangle_is_refused(capture, tmp_path, change, rest, says):
    ply = ga_file(tmp_path / "in.ply", [{**ROWS[0], **change}], rest)
    with pytest.raises(InputError, match=says):
        imported(capture, tmp_path / "out", ply)
    assert not (tmp_path / "out").exists()


KEYS = ("expr", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "translation")


def flame_param(capture, path, change=None):
    """What the official training stores beside its splats: the capture's parameters in rows by timestep, refined a little."""
    clip = read_capture(capture)
    listed = [json.loads((capture / f"transforms_{s}.json").read_text()) for s in ("train", "val", "test")]
    by_timestep = {
        frame["timestep_index"]: dict(np.load(capture / frame["flame_param_path"]))
        for part in listed
        for frame in part["frames"]
    }
    rows = [by_timestep[timestep] for timestep in range(len(by_timestep))]
    arrays = {key: np.concatenate([row[key] for row in rows]) for key in KEYS}
    train = clip.timesteps("train")
    arrays["jaw_pose"][train] += np.float32(0.125)
    arrays["translation"][train] += np.float32(0.01)
    arrays |= {"shape": rows[0]["shape"], "static_offset": rows[0]["static_offset"]}
    arrays["dynamic_offset"] = np.zeros((len(rows), *arrays["static_offset"].shape[1:]), np.float32)
    np.savez(path, **(arrays | (change or {})))
    return path


def with_beside(tmp_path, **settings):
    ply = ga_file(tmp_path / "point_cloud.ply", ROWS)
    findings = import_avatar(ImportGASettings(str(ply), out=str(tmp_path / "out"), **settings))
    return GA().load(tmp_path / "out", device="cpu"), findings


def test_stored_parameters_refine_training_poses_only(capture, tmp_path):
    flame_param(capture, tmp_path / "flame_param.npz")
    avatar, findings = with_beside(tmp_path, capture=str(capture))
    clip = read_capture(capture)
    assert f"{len(clip.poses)} timesteps, {len(clip.timesteps('train'))} of them" in findings.text
    plain = GA().load(plain_import(capture, tmp_path, of_refined=True), device="cpu")
    for timestep, pose in clip.poses.items():
        shown = pose
        if timestep in clip.timesteps("train"):
            moved = pose.translation + np.float32(0.01)
            shown = replace(pose, jaw=pose.jaw + np.float32(0.125), translation=moved)
        found, expected = avatar.splats(pose), plain.splats(shown)
        np.testing.assert_allclose(found.means, expected.means, atol=1e-6)


def plain_import(capture, tmp_path, of_refined=False):
    """An import without stored parameters, into a folder that an import with them was made in before."""
    ply = ga_file(tmp_path / "point_cloud.ply", ROWS)
    out = tmp_path / "plain"
    if of_refined:
        import_avatar(ImportGASettings(str(ply), capture=str(capture), out=str(out)))
    import_avatar(ImportGASettings(str(ply), capture=str(capture), out=str(out), flame_param="none"))
    return out


@pytest.mark.parametrize("rows", [1, None])
def test_no_capture_is_needed_with_stored_parameters(capture, tmp_path, rows):
    """Of one timestep, too; the avatar is the same in the same pose."""
    path = flame_param(capture, tmp_path / "flame_param.npz")
    arrays = dict(np.load(path))
    np.savez(path, **{k: v[:rows] if k in KEYS else v for k, v in arrays.items()})
    head = tmp_path / "head.npz"
    save_head(head, read_capture(capture).head)
    avatar, findings = with_beside(tmp_path, head=str(head), subject="nobody")
    assert findings.data["subject"] == "nobody"
    pose = read_capture(capture).poses[0]
    other = GA().load(plain_import(capture, tmp_path), device="cpu")
    np.testing.assert_allclose(avatar.splats(pose).means, other.splats(pose).means, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "settings", "says"),
    [
        ({"shape": np.full(4, 0.5, np.float32)}, {}, "shape of subject .*--flame-param none"),
        ({"jaw_pose": np.zeros((2, 3), np.float32)}, {}, "jaw_pose: expected a row for each of"),
        ({"expr": np.zeros((2, 2, 2), np.float32)}, {}, "expr"),
        ({"rotation": np.full((9, 3), np.nan, np.float32)}, {}, "rotation"),
        (
            {key: np.zeros((2, 6 if key == "eyes_pose" else 3), np.float32) for key in KEYS},
            {},
            "training timestep",
        ),
        ({}, {"capture": None}, "--head"),
        (None, {"capture": None}, "neither.*--capture"),
        ({}, {"flame_param": "nowhere.npz"}, "nowhere.npz"),
    ],
)
def test_stored_parameters_that_do_not_fit_are_refused(capture, tmp_path, change, settings, says):
    if change is not None:
        flame_param(capture, tmp_path / "flame_param.npz", change)
    with pytest.raises(InputError, match=says):
        with_beside(tmp_path, **{"capture": str(capture), **settings})
    assert not (tmp_path / "out").exists()
