"""The folder for LAM's viewers: what its files hold, by their formats, against the splats that an avatar has."""

import json
import struct
import zipfile
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.contracts import Frame, no_progress
from headbench.bench.errors import InputError
from headbench.datasets.drive.signal import ARKIT, blendshape_parts
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.head.procedural.model import procedural_head
from headbench.methods.avatars import lam
from headbench.methods.avatars.export import neutral_pose
from headbench.methods.avatars.settings import ExportLamSettings
from headbench.methods.avatars.web.bake import Source
from headbench.methods.avatars.web.export import Opened
from headbench.methods.shared.rendering import PosedSplats


class VertexSplats:
    """An avatar with a round splat at every eighth vertex of a mean head."""

    def __init__(self, head):
        self.subject = PosedSubject(head, np.zeros(head.shape_basis.shape[2]), np.zeros_like(head.template))
        self.colors = np.random.default_rng(0).uniform(size=head.template[::8].shape).astype(np.float32)

    def splats(self, pose, camera=None):
        means = self.subject.meshes([pose])[0, ::8].astype(np.float32)
        quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1))
        scales = np.tile(np.array([0.004, 0.005, 0.006], np.float32), (len(means), 1))
        opacities = np.linspace(0, 1, len(means), dtype=np.float32)
        return PosedSplats(means, quats, scales, opacities, None if camera is None else self.colors)

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        white = np.ones((camera.height, camera.width, 3), np.float32)
        return Frame(white, white[..., 0])


@pytest.fixture(scope="module")
def source():
    head = procedural_head()
    joints = head.joint_regressor @ head.template
    return Source(VertexSplats(head), neutral_pose(head), joints[0], joints[1:])


@pytest.fixture(scope="module")
def exported(source, tmp_path_factory):
    """A folder and an archive, as the command writes them, and its result."""
    home = tmp_path_factory.mktemp("lam")
    opened = Opened(None, procedural_head(), source, None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lam, "open_source", lambda settings, progress: opened)
        patch.setattr(lam, "psnr", lambda *arguments: 30.0)
        for out in ("face", "face.zip"):
            result = lam.export_lam(ExportLamSettings("avatar", str(home / out)), no_progress)
    return home, result


def glb(path):
    """Header of a file, and a function that returns an accessor's values."""
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    (size,) = struct.unpack_from("<I", content, 12)
    header, body = json.loads(content[20 : 20 + size]), content[28 + size :]

    def values(number):
        accessor = header["accessors"][number]
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        if "bufferView" not in accessor:
            return np.zeros((accessor["count"], columns))
        kind = {5121: "u1", 5123: "<u2", 5126: "<f4"}[accessor["componentType"]]
        start = header["bufferViews"][accessor["bufferView"]]["byteOffset"]
        assert start % np.dtype(kind).itemsize == 0
        block = np.frombuffer(body, kind, accessor["count"] * columns, start)
        return block.reshape(accessor["count"], columns)

    return header, values


def parts_of(path):
    """Header, vertices, and morph targets by name of a mesh."""
    header, values = glb(path / "skin.glb")
    (mesh,) = header["meshes"]
    (primitive,) = mesh["primitives"]
    attributes = {name: values(number) for name, number in primitive["attributes"].items()}
    targets = [values(target["POSITION"]) for target in primitive["targets"]]
    return header, attributes, dict(zip(mesh["extras"]["targetNames"], targets, strict=True))


def test_the_mesh_has_the_splats_at_rest(exported, source):
    home, _ = exported
    header, attributes, morphs = parts_of(home / "face")
    splats = source.avatar.splats(source.rest)
    np.testing.assert_allclose(attributes["POSITION"], splats.means, atol=1e-6)
    assert (*morphs,) == ARKIT
    assert len(ARKIT) == 52
    np.testing.assert_allclose(attributes["WEIGHTS_0"].sum(axis=1), 1, atol=1e-6)
    names = [header["nodes"][number]["name"] for number in header["skins"][0]["joints"]]
    assert names == ["hip", "head", "jaw", "leftEye", "rightEye"]
    chin = splats.means[:, 1].argmin()
    assert names[attributes["JOINTS_0"][chin, 0]] == "hip"  # the end of the neck
    order = json.loads((home / "face" / "vertex_order.json").read_text())
    assert sorted(order) == list(range(len(splats.means)))
    assert (np.diff(splats.means[order, 2]) >= 0).all()


def test_splats_are_read_with_eight_bits(exported, source):
    home, _ = exported
    header, _, body = (home / "face" / "offset.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property")]
    table = np.frombuffer(body, "<f4").reshape(-1, len(names)).T
    columns = dict(zip(names, table.astype(np.float64)))
    splats = source.avatar.splats(source.rest)
    for number, axis in enumerate("xyz"):
        assert not columns[axis].any()
        shown = np.floor(255 * columns[f"f_dc_{number}"]).clip(0, 255)
        np.testing.assert_array_equal(shown, np.round(255 * source.avatar.colors[:, number]))
        np.testing.assert_allclose(np.exp(columns[f"scale_{number}"]), splats.scales[:, number], rtol=1e-6)
    shown = np.floor(255 / (1 + np.exp(-columns["opacity"])))
    np.testing.assert_array_equal(shown, np.round(255 * splats.opacities.astype(np.float64)).clip(0, 254))
    np.testing.assert_allclose([columns[f"rot_{number}"][0] for number in range(4)], [1, 0, 0, 0], atol=1e-6)


@pytest.mark.parametrize("name", ["mouthSmileLeft", "jawOpen", "eyeLookUpRight", "eyeBlinkLeft"])
def test_morphs_are_the_displacements_of_the_head(exported, source, name):
    home, _ = exported
    _, _, morphs = parts_of(home / "face")
    pose = replace(source.rest, **blendshape_parts(procedural_head())[name])
    displaced = source.avatar.splats(pose).means - source.avatar.splats(source.rest).means
    assert np.abs(displaced).max() > 1e-3
    np.testing.assert_allclose(morphs[name], displaced, atol=5e-6)
    # which counters the open jaw
    np.testing.assert_allclose(morphs["mouthClose"], -morphs["jawOpen"], atol=1e-5)


def test_heads_without_names_perform_the_same_shapes():
    head = procedural_head()
    size = head.expression_basis.shape[2]
    mixed = np.linalg.qr(np.random.default_rng(1).normal(size=(size, size)))[0]
    other = replace(head, version="flame2020", expression_basis=head.expression_basis @ mixed)
    meshes = []
    for model in (head, other):
        rest = neutral_pose(model)
        single, together, residual = lam.perform(model, rest, no_progress)
        subject = VertexSplats(model).subject
        meshes.append(
            subject.meshes([*(face.pose for face in single), together.pose]) - subject.meshes([rest])
        )
    assert 0 < residual < 0.1
    np.testing.assert_allclose(*meshes, atol=2e-4)
    assert np.abs(meshes[0][ARKIT.index("mouthSmileLeft")]).max() > 5e-3


def test_bones_place_the_head_before_the_camera(exported, source):
    home, _ = exported
    header, values = glb(home / "face" / "skin.glb")
    animated, clips = glb(home / "face" / "animation.glb")
    (clip,) = animated["animations"]
    (channel,) = clip["channels"]
    assert animated["nodes"][channel["target"]["node"]]["name"] == "head"
    np.testing.assert_array_equal(clips(clip["samplers"][0]["output"]), [[0, 0, 0, 1]] * 2)
    hip, head = (np.array(node["translation"]) for node in header["nodes"][:2])
    inverse = values(header["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4)
    place = hip + head + inverse[1, 3, :3]  # translation of the splats at rest
    means = source.avatar.splats(source.rest).means + place - [0, 1.8, 1]
    depth = -means @ [0, np.sin(np.radians(10)), np.cos(np.radians(10))]
    up = means @ [0, np.cos(np.radians(10)), -np.sin(np.radians(10))]
    assert depth.min() > 0.1
    assert 0.5 < np.abs(up / depth).max() / np.tan(np.radians(25)) < 1


@pytest.mark.parametrize("empty", [False, True])
def test_avatars_that_viewers_cannot_show_are_refused(source, tmp_path, empty):
    opened = Opened(None, procedural_head(), source, None)
    settings = ExportLamSettings("avatar", str(tmp_path / "face.zip"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lam, "open_source", lambda settings, progress: opened)
        patch.setattr(lam, "MOST_SPLATS", 100)
        if empty:
            nothing = SimpleNamespace(means=np.empty((0, 3)))
            patch.setattr(source.avatar, "splats", lambda pose: nothing, raising=False)
        with pytest.raises(InputError, match="of 1 to 100 splats"):
            lam.export_lam(settings, no_progress)
    assert not [*tmp_path.iterdir()]


def test_folders_of_something_else_are_refused(tmp_path):
    (tmp_path / "mine.txt").touch()
    with pytest.raises(InputError, match="that of an earlier export, found also mine.txt"):
        lam.export_lam(ExportLamSettings("avatar", str(tmp_path)))


def test_archives_have_an_entry_for_their_folder(exported):
    home, result = exported
    with zipfile.ZipFile(home / "face.zip") as archive:
        names = archive.namelist()
        assert names[0] == "face/"
        for name in lam.FILES:
            assert archive.read(f"face/{name}") == (home / "face" / name).read_bytes()
    assert sorted(names[1:]) == sorted(f"face/{name}" for name in lam.FILES)
    assert result.data["missing"] == ["mouthShrugUpper", "tongueOut"]
    assert result.data["bytes"] == (home / "face.zip").stat().st_size


def test_what_is_read_is_what_was_written(exported, source):
    home, _ = exported
    found = lam.read_folder(home / "face")
    values = np.array([name == "jawOpen" for name in ARKIT], np.float64)
    moved = found.moved(values, np.array([0, 0.3, 0]))
    pose = replace(source.rest, jaw=np.array([0.44, 0, 0]))
    wanted = source.seen(pose).means - source.joints[0]
    cosine, sine = np.cos(0.3), np.sin(0.3)
    turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    np.testing.assert_allclose(moved.means, wanted @ turn.T + source.joints[0], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(moved.axes, axis=1)[0], [0.004, 0.005, 0.006], rtol=1e-5)
