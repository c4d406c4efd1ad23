"""Avatars of every splat method as glTF and SOG: read back by a parser of the tests, or by the library's."""

import json
import re
import struct
import sys
import zipfile

import numpy as np
import pytest

from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.runner.stored import avatar_folder
from headbench.methods.gaussian_ply.command import (
    ExportGlbSettings,
    ExportPlySettings,
    ExportSogSettings,
    export_glb,
    export_ply,
    export_sog,
)
from headbench.methods.gaussian_ply.export import neutral_pose, read_splat_avatar
from headbench.methods.shared.avatar_files import read_shared_head
from headbench.methods.web.command import ExportHtmlSettings, export_html

from ...small_run import small_run

METHODS = ("ga", "gbs", "gha", "ours")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return small_run(tmp_path_factory.mktemp("formats"), *METHODS)


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
    avatar = read_splat_avatar(folder)
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


@pytest.mark.parametrize("method", METHODS)
def test_sog_loses_little(run, tmp_path, method):
    pytest.importorskip("gaussforge")
    folder, out = folder_of(run, method), tmp_path / "x.sog"
    packed = export_sog(ExportSogSettings(str(folder), out=str(out)))
    names = set(zipfile.ZipFile(out).namelist())
    assert {"meta.json", "means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp"} <= names
    whole = export_ply(ExportPlySettings(str(folder), out=str(tmp_path / "x.ply")))
    assert packed.data["splats"] == whole.data["splats"]
    assert packed.data["psnr"] > min(35, whole.data["psnr"] - 3)
    assert re.search(r"[\d.]+ dB or more", packed.text)


def test_without_the_library_the_error_says_what_to_install(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    out = tmp_path / "x.sog"
    with pytest.raises(UnavailableError, match="pip install gaussforge"):
        export_sog(ExportSogSettings(str(folder_of(run, "ga")), out=str(out)))
    assert not out.exists()


def test_a_page_cannot_hold_what_a_network_draws(run, tmp_path):
    settings = ExportHtmlSettings(str(folder_of(run, "gha")), str(tmp_path / "x.html"))
    with pytest.raises(InputError, match=r"one of gha.*headbench view"):
        export_html(settings)
