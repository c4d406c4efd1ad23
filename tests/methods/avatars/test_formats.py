"""Avatars of every splat method as glTF and SOG, read back by parsers of the tests."""

import io
import json
import re
import struct
import sys
import zipfile

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from headbench.bench.engine.stored import avatar_folder, load_avatar
from headbench.bench.errors import UnavailableError
from headbench.methods.avatars.export import FORMATS, export_glb, export_ply, export_sog, neutral_pose
from headbench.methods.avatars.settings import (
    ExportGlbSettings,
    ExportHtmlSettings,
    ExportPlySettings,
    ExportSogSettings,
)
from headbench.methods.avatars.web.export import export_page
from headbench.methods.shared.avatar_files import read_shared_head

from ...world import finished

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
