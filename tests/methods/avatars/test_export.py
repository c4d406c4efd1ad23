"""Avatars as standard splat files, read back by a parser that knows nothing of ours, and drawn."""

import io
import json
import re
import struct
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from scipy.spatial import cKDTree
from scipy.special import sph_harm_y

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine.stored import avatar_folder, load_avatar
from headbench.bench.errors import InputError, UnavailableError
from headbench.datasets.ga import reader
from headbench.datasets.ga.reader import read_capture
from headbench.methods.avatars.export import FORMATS, export_glb, export_ply, export_sog, neutral_pose
from headbench.methods.avatars.harmonics import fit_harmonics, sphere, visibility
from headbench.methods.avatars.settings import (
    ExportGlbSettings,
    ExportHtmlSettings,
    ExportPlySettings,
    ExportSogSettings,
)
from headbench.methods.avatars.web.export import export_page
from headbench.methods.ga.method import GA
from headbench.methods.ga.spec import GAConfig
from headbench.methods.gbs.method import GBS
from headbench.methods.gbs.spec import GBSConfig
from headbench.methods.ops.planes import sh_basis
from headbench.methods.ours.method import OursAvatar
from headbench.methods.shared.avatar_files import read_shared_head
from headbench.methods.shared.rendering import PosedSplats, view_of
from headbench.methods.splats import rasterize
from headbench.methods.trivial.method import NearestCamera

from ...datasets.tiny_capture import write_tiny_capture
from ...world import finished
from ..ours.toy import SMALL, store
from ..recorded import recorded

METHODS = ("ga", "gbs", "gha", "ours")


@pytest.fixture(scope="module")
def run():
    return finished()


def folder_of(run, method):
    return avatar_folder(run.cell("901", method, 0).folder)


def parse_glb(content):
    """Header and attributes by name, checked chunk by chunk."""
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    header = json.loads(content[20 : 20 + size])
    binary, kind = struct.unpack_from("<I4s", content, 20 + size)
    assert kind == b"BIN\0"
    body = content[28 + size :]
    assert len(body) == binary == header["buffers"][0]["byteLength"]
    (primitive,) = header["meshes"][0]["primitives"]
    values = {}
    for name, number in primitive["attributes"].items():
        accessor = header["accessors"][number]
        view = header["bufferViews"][accessor["bufferView"]]
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert view["byteLength"] == 4 * columns * accessor["count"]
        block = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        values[name.removeprefix("KHR_gaussian_splatting:")] = np.frombuffer(block, "<f4").reshape(
            -1, columns
        )
    return header, values


@pytest.mark.parametrize("method", METHODS)
def test_gltf_holds_the_splats_as_the_extension_says(run, tmp_path, method):
    folder, out = folder_of(run, method), tmp_path / "x.glb"
    findings = export_glb(ExportGlbSettings(str(folder), out=str(out)))
    header, found = parse_glb(out.read_bytes())
    avatar = load_avatar(folder)
    splats = avatar.splats(neutral_pose(read_shared_head(folder)))
    np.testing.assert_array_equal(found["POSITION"], splats.means)
    np.testing.assert_array_equal(found["SCALE"], splats.scales)
    np.testing.assert_array_equal(found["OPACITY"][:, 0], splats.opacities)
    np.testing.assert_allclose(found["ROTATION"], splats.quats[:, [1, 2, 3, 0]], atol=1e-6)
    assert len([name for name in found if name.startswith("SH_DEGREE_3")]) == 7
    assert header["extensionsUsed"] == ["KHR_gaussian_splatting"]
    (primitive,) = header["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert extension == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    position = header["accessors"][primitive["attributes"]["POSITION"]]
    assert position["min"] == pytest.approx(splats.means.min(0).tolist())
    assert header["asset"]["generator"].startswith("headbench")
    assert "trainedAlgorithmicMedia" in header["asset"]["extras"]["note"]
    assert findings.data["psnr"] > (100 if method == "ga" else 30)


def decode_sog(path):
    """Header and columns of a SOG, version 2, by the formulas of PlayCanvas' specification."""
    archive = zipfile.ZipFile(path)
    meta = json.loads(archive.read("meta.json"))
    assert meta["version"] == 2
    count = meta["count"]

    def image(name):
        return np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGBA")).astype(int)

    def pixels(part):
        return [image(name).reshape(-1, 4)[:count] for name in meta[part]["files"]]

    low, high = pixels("means")
    least, most = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    logs = least + (most - least) * (256 * high + low)[:, :3] / 65535
    (sizes,), (turns,), (base,) = pixels("scales"), pixels("quats"), pixels("sh0")
    left_out = turns[:, 3] - 252  # the largest of w, x, y, z
    assert set(left_out) <= {0, 1, 2, 3}
    others = (turns[:, :3] / 255 - 0.5) * np.sqrt(2)
    quats = np.empty((count, 4))
    for number in range(4):
        rows = left_out == number
        quats[np.ix_(rows, np.delete(np.arange(4), number))] = others[rows]
        quats[rows, number] = np.sqrt(1 - (others[rows] ** 2).sum(1))
    assert meta["shN"]["bands"] == 3
    centroids_name, labels_name = meta["shN"]["files"]
    centroids, labels = image(centroids_name), image(labels_name).reshape(-1, 4)[:count]
    entry = labels[:, 0] + 256 * labels[:, 1]
    taken = [centroids[entry // 64, 15 * (entry % 64) + k, :3] for k in range(15)]
    return meta, {
        "means": np.sign(logs) * np.expm1(np.abs(logs)),
        "quats": quats,
        "scales": np.exp(np.array(meta["scales"]["codebook"])[sizes[:, :3]]),
        "opacities": base[:, 3] / 255,
        "dc": np.array(meta["sh0"]["codebook"])[base[:, :3]],
        "rest": np.array(meta["shN"]["codebook"])[np.stack(taken, axis=2)],
    }


@pytest.mark.parametrize("method", ["ga", "ours"])
def test_sog_holds_the_splats_as_its_specification_says(run, tmp_path, method):
    pytest.importorskip("gaussforge")
    folder, out = str(folder_of(run, method)), str(tmp_path / "x")
    packed = export_sog(ExportSogSettings(folder, out=f"{out}.sog"))
    whole = export_ply(ExportPlySettings(folder, out=f"{out}.ply"))
    assert packed.data["splats"] == whole.data["splats"]
    assert packed.data["psnr"] > min(35, whole.data["psnr"] - 3)
    assert re.search(r"[\d.]+ dB or more", packed.text)
    meta, found = decode_sog(f"{out}.sog")
    assert meta["asset"]["generator"].startswith("headbench")
    assert "trainedAlgorithmicMedia" in meta["asset"]["note"]
    splats = FORMATS["ply"].read(tmp_path / "x.ply")._asdict()
    # SOG orders splats anew.
    distance, order = cKDTree(splats["means"].numpy()).query(found["means"])
    assert distance.max() < 1e-4
    assert len(np.unique(order)) > 0.95 * len(order)
    turned = np.abs((found["quats"] * splats["quats"].numpy()[order]).sum(1))
    assert np.quantile(turned, 0.05) > 0.999
    for name in ("scales", "opacities", "dc", "rest"):
        expected = splats[name].numpy()[order]
        assert np.quantile(np.abs(found[name] - expected), 0.95) <= 0.02 * max(np.abs(expected).max(), 1e-6)


def test_without_the_library_the_error_says_what_to_install(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    out = tmp_path / "x.sog"
    with pytest.raises(UnavailableError, match=r"pip install -e '.\[formats\]'"):
        export_sog(ExportSogSettings(str(folder_of(run, "ga")), out=str(out)))
    assert not out.exists()


@pytest.mark.commands
def test_a_page_holds_what_a_network_draws_as_its_splats_are(run, tmp_path):
    settings = ExportHtmlSettings(str(folder_of(run, "gha")), str(tmp_path / "x.html"), expressions=1)
    assert export_page(settings).data["psnr"]["rest"] > 25


NAMES = [
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


def parse(path):
    """(N, 62) of a standard file, byte by byte; nothing but the exact layout passes."""
    content = path.read_bytes()
    header, body = content.split(b"end_header\n", 1)
    lines = header.decode("ascii").split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    assert lines[3:-2] == [f"property float {name}" for name in NAMES]
    assert lines[-2].endswith("trainedAlgorithmicMedia")
    assert len(body) == count * 248
    return np.array([struct.unpack("<62f", body[248 * i : 248 * (i + 1)]) for i in range(count)])


def exported(folder, out, **options):
    """The table written, and the findings."""
    findings = export_ply(ExportPlySettings(str(folder), out=str(out), **options))
    return parse(out), findings


def viewed(table, camera):
    """What a viewer of 3DGS does with such a table."""
    values = torch.from_numpy(table.astype(np.float32))
    view = view_of(camera, "cpu")
    means, logits, scales, quats = values[:, :3], values[:, 54], values[:, 55:58].exp(), values[:, 58:]
    harmonics = torch.cat([values[:, 6:9, None], values[:, 9:54].view(-1, 3, 15)], dim=2)
    directions = torch.nn.functional.normalize(means - view.center, dim=1)
    colors = torch.relu(0.5 + (harmonics * sh_basis(directions, 3)[:, None]).sum(2))
    return rasterize(
        *(means, quats, scales, torch.sigmoid(logits), colors),
        *(view.world_to_camera, view.K, camera.width, camera.height),
        background=torch.ones(3),
    ).image.numpy()


def soft(values):
    """Colours that vary little enough with direction for harmonics, and are not cut at 0."""
    values["color_weight_0"][:, -27:] *= 0.3
    values["color_weight_1"] *= 0.5


@pytest.mark.parametrize("color", ["planes", "sh"])
def test_a_viewer_shows_what_the_avatar_shows(color, clip, tmp_path):
    config = replace(SMALL, color=color, sh_degree=2)
    folder = store(clip, tmp_path / "avatar", config, (lambda _: None) if color == "sh" else soft)
    table, findings = exported(folder, tmp_path / "x.ply", directions=128)
    avatar, pose = OursAvatar.read(folder, "cpu"), neutral_pose(clip.head)
    splats = avatar.splats(pose)
    assert findings.data["splats"] == len(table) == len(splats.means)
    np.testing.assert_array_equal(table[:, :3], splats.means)
    np.testing.assert_array_equal(table[:, 58:], splats.quats)
    np.testing.assert_allclose(np.exp(table[:, 55:58]), splats.scales, rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-table[:, 54])), splats.opacities, atol=1e-6)
    assert not table[:, 3:6].any()
    assert findings.data["residual_rms"] < 0.05
    for camera in clip.cameras.values():
        error = np.mean((viewed(table, camera).clip(0, 1) - avatar.render(camera, pose).rgb) ** 2)
        assert -10 * np.log10(error) > 32


def test_the_pose_of_a_capture_is_written(tmp_path):
    capture = write_tiny_capture(tmp_path / "capture").union
    clip = read_capture(capture)
    folder, options = tmp_path / "ga", {"device": "cpu", "seed": 0, "progress": no_progress}
    avatar = GA(GAConfig(refine_tracking=False)).fit(clip, folder, Budget(iterations=3), **options)
    recorded(folder, "ga", clip)
    timestep = clip.timesteps("self_reenactment")[0]
    table, _ = exported(folder, tmp_path / "x.ply", capture=str(capture), timestep=timestep)
    np.testing.assert_array_equal(table[:, :3], avatar.splats(clip.poses[timestep]).means)
    camera = next(iter(clip.cameras.values()))
    difference = viewed(table, camera).clip(0, 1) - avatar.render(camera, clip.poses[timestep]).rgb
    assert np.abs(difference).max() < 1e-4
    with pytest.raises(InputError, match="timestep"):
        export_ply(ExportPlySettings(str(tmp_path / "ga"), out="x", capture=str(capture), timestep=10**6))
    with pytest.raises(InputError, match=r"avatar\.json"):
        export_ply(ExportPlySettings(str(capture), out="x"))


def test_a_viewer_shows_a_blendshape_avatar_in_a_turned_pose(tmp_path):
    capture = write_tiny_capture(tmp_path / "capture").union
    clip = read_capture(capture)
    method = GBS(GBSConfig(samples=200, teeth_samples=10, expressions=4))
    method.fit(clip, tmp_path / "gbs", Budget(iterations=1), device="cpu", seed=0, progress=no_progress)
    recorded(tmp_path / "gbs", "gbs", clip, method.config)
    file = tmp_path / "gbs" / "avatar.safetensors"
    with safe_open(file, "pt") as stream:
        metadata = stream.metadata()
    tensors = load_file(file)
    tensors["splats"][:, 11:] = 0.3 * torch.randn(tensors["splats"][:, 11:].shape)
    save_file(tensors, file, metadata)
    avatar = GBS(method.config).load(tmp_path / "gbs", device="cpu")
    timestep = clip.timesteps("self_reenactment")[0]
    pose = replace(clip.poses[timestep], rotation=np.array([0.3, -0.8, 0.2]))
    fixed = {"poses": {**clip.poses, timestep: pose}}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reader, "read_capture", lambda *_, **__: replace(clip, **fixed))
        table, _ = exported(tmp_path / "gbs", tmp_path / "x.ply", capture=str(capture), timestep=timestep)
    assert np.abs(table[:, 9:54]).max() > 0.1
    for camera in clip.cameras.values():
        shown = viewed(table, camera).clip(0, 1)
        assert np.ptp(shown) > 0.1
        np.testing.assert_allclose(shown, avatar.render(camera, pose).rgb, atol=1e-3)


def test_an_avatar_without_splats_is_refused(clip, tmp_path):
    options = {"device": "cpu", "seed": 0, "progress": no_progress}
    NearestCamera().fit(clip, tmp_path, Budget(iterations=1), **options)
    recorded(tmp_path, "nearest-camera", clip)
    for command, settings in ((export_ply, ExportPlySettings), (export_page, ExportHtmlSettings)):
        with pytest.raises(
            InputError, match="an avatar of splats, found one of nearest-camera.*headbench view"
        ):
            command(settings(str(tmp_path), out=str(tmp_path / "x")))
        assert not (tmp_path / "x").exists()


def test_colours_that_are_harmonics_are_found_exactly():
    """Against scipy's complex harmonics, of degree 3: any real combination of them must be fitted without residual."""
    directions = sphere(128)
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(5, 3, 16, 2)) * 0.1

    def radiance(direction):
        x, y, z = direction.double().numpy()
        values = [
            sph_harm_y(degree, order, np.arccos(z), np.arctan2(y, x))
            for degree in range(4)
            for order in range(-degree, degree + 1)
        ]
        parts = np.stack([np.real(values), np.imag(values)], axis=1)
        return torch.from_numpy(0.5 + (weights * parts).sum((2, 3))).float()

    fit = fit_harmonics(radiance, torch.from_numpy(rng.uniform(size=(5, 128))).float(), directions)
    assert fit.residual.max() < 1e-4
    unseen = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(20, 3))).float(), dim=1)
    basis = sh_basis(-unseen, 3)
    found = 0.5 + torch.einsum("mk,nck->nmc", basis, torch.cat([fit.dc[:, :, None], fit.rest], dim=2))
    expected = torch.stack([radiance(direction) for direction in unseen], dim=1)
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_a_splat_behind_a_wall_shows_from_behind_alone():
    """A wall of opaque splats at z = 0, and one splat behind it."""
    wall = np.array([[x, y, 0.0] for x in np.linspace(-1, 1, 21) for y in np.linspace(-1, 1, 21)])
    means = np.concatenate([wall, [[0.0, 0.0, -0.2]]]).astype(np.float32)
    count = len(means)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    splats = PosedSplats(
        means, quats, np.full((count, 3), 0.06, np.float32), np.full(count, 0.99, np.float32), None
    )
    directions = sphere(200)
    shown = visibility(splats, directions.numpy())[-1]
    assert shown[directions[:, 2] > 0.8].max() < 0.05
    assert shown[directions[:, 2] < -0.8].min() > 0.5
