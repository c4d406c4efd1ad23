"""``headbench export compact`` on an avatar trained on a capture on disk."""

import re

import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine.stored import load_avatar
from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.methods.avatars.compact.measure import compact_avatar
from headbench.methods.avatars.compact.settings import CompactSettings
from headbench.methods.ours.method import Ours
from headbench.methods.shared.config import SplatTraining
from headbench.methods.trivial.method import NearestCamera

from ....datasets.tiny_capture import make_plan, write_tiny_capture
from ...ours.toy import SMALL, changed
from ...recorded import recorded


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Capture and folder of an avatar."""
    root = tmp_path_factory.mktemp("compact")
    capture = write_tiny_capture(root / "capture").union
    settings = {"penalty": {"weight": 0.0}, "sampling": {"balanced": False}}
    method = Ours(changed(SMALL, splats=SplatTraining(min_settle=4), **settings))
    clip, budget = read_capture(capture), Budget(iterations=30)
    method.fit(clip, root / "avatar", budget, device="cpu", seed=0, progress=no_progress)
    return capture, recorded(root / "avatar", "ours", clip, method.config)


def test_parts_and_their_costs_are_told(trained, tmp_path):
    capture, avatar = trained
    settings = CompactSettings(str(avatar), out=str(tmp_path), compare=str(capture), frames=3)
    findings = compact_avatar(settings)
    data, quality = findings.data, findings.data["quality"]
    assert data["frames"] == 3
    assert data["whole"]["compact_bytes"] == (tmp_path / "compact.safetensors").stat().st_size
    assert sum(part["compact_bytes"] for part in data["parts"].values()) < data["whole"]["compact_bytes"]
    for name in ("positions", "scales", "rotations", "opacities", "planes", "networks"):
        assert 0 < data["parts"][name]["compact_bytes"] < data["whole"]["exact_bytes"] / 2
        to_exact = quality[name]["psnr_exact"]
        assert to_exact is None or to_exact >= quality["all"]["psnr_exact"] - 3
    # Nothing rounded, but what no training pose shows may show in a held-out one.
    assert (quality["left out"]["psnr_exact"] or 99) > 45
    assert abs(quality["all"]["psnr"] - data["exact"]["psnr"]) < 0.5
    for name in (*data["parts"], "left out", "all"):
        assert re.search(rf"^{name}\b", findings.text, re.MULTILINE)
    assert load_avatar(tmp_path).subject.name == "901"


@pytest.mark.parametrize("cell", [False, True])
def test_without_a_capture_only_sizes_are_told(trained, tmp_path, cell):
    avatar = trained[1].parent if cell else trained[1]  # the folder that has it as "avatar" is one of a cell
    findings = compact_avatar(CompactSettings(str(avatar), out=str(tmp_path)))
    assert "quality" not in findings.data
    assert findings.data["splats_kept"] == findings.data["splats"]
    assert "dB" not in findings.text


def test_enlarged_pictures_have_no_truth(trained, tmp_path):
    settings = CompactSettings(str(trained[1]), out=str(tmp_path), compare=str(trained[0]), frames=1, scale=2)
    findings = compact_avatar(settings)
    assert findings.data["exact"]["psnr"] is None
    assert findings.data["quality"]["all"]["psnr_exact"] > 20


def test_what_does_not_belong_together_is_refused(trained, tmp_path):
    (tmp_path / "a.txt").touch()
    with pytest.raises(InputError, match=r"avatar\.json"):
        compact_avatar(CompactSettings(str(tmp_path), out=str(tmp_path / "out")))
    clip = read_capture(trained[0])
    options = {"device": "cpu", "seed": 0, "progress": no_progress}
    NearestCamera().fit(clip, tmp_path / "nearest", Budget(iterations=1), **options)
    recorded(tmp_path / "nearest", "nearest-camera", clip)
    with pytest.raises(InputError, match="trained avatar of a native.*found an avatar of nearest-camera"):
        compact_avatar(CompactSettings(str(tmp_path / "nearest"), out=str(tmp_path / "out")))
    other = write_tiny_capture(tmp_path / "other", make_plan(subject="902")).union
    with pytest.raises(InputError, match="902"):
        compact_avatar(CompactSettings(str(trained[1]), out=str(tmp_path / "out"), compare=str(other)))
    assert not (tmp_path / "out").exists()
