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
    clip, budget = read_capture(capture), Budget(iterations=12)
    method.fit(clip, root / "avatar", budget, device="cpu", seed=0, progress=no_progress)
    return capture, recorded(root / "avatar", "ours", clip, method.config)


@pytest.mark.parametrize("scale", [1, 2])
def test_bytes_and_quality_by_part(trained, tmp_path, scale):
    capture, avatar = trained
    settings = CompactSettings(str(avatar), out=str(tmp_path), compare=str(capture), frames=2, scale=scale)
    result = compact_avatar(settings)
    data, quality = result.data, result.data["quality"]
    assert data["frames"] == 2
    assert data["whole"]["compact_bytes"] == (tmp_path / "compact.safetensors").stat().st_size
    assert sum(part["compact_bytes"] for part in data["parts"].values()) < data["whole"]["compact_bytes"]
    for name in ("positions", "scales", "rotations", "opacities", "planes", "networks"):
        assert 0 < data["parts"][name]["compact_bytes"] < data["whole"]["exact_bytes"] / 2
        to_exact = quality[name]["psnr_exact"]
        assert to_exact is None or to_exact >= quality["all"]["psnr_exact"] - 3
    if scale == 1:
        assert abs(quality["all"]["psnr"] - data["exact"]["psnr"]) < 0.5
    else:  # there is no ground truth of this size
        assert data["exact"]["psnr"] is None
        assert quality["all"]["psnr_exact"] > 20
    for name in (*data["parts"], "all"):
        assert re.search(rf"^{name}\b", result.text, re.MULTILINE)
    assert load_avatar(tmp_path).subject.name == "901"


@pytest.mark.parametrize("cell", [False, True])
def test_without_a_capture_only_sizes_are_measured(trained, tmp_path, cell):
    avatar = trained[1].parent if cell else trained[1]  # the folder that has it as "avatar" is one of a cell
    result = compact_avatar(CompactSettings(str(avatar), out=str(tmp_path)))
    assert "quality" not in result.data
    assert result.data["splats"] > 100
    assert "dB" not in result.text


def test_the_capture_of_another_subject_is_refused(trained, tmp_path):
    other = write_tiny_capture(tmp_path / "other", make_plan(subject="902")).union
    with pytest.raises(InputError, match="902"):
        compact_avatar(CompactSettings(str(trained[1]), out=str(tmp_path / "out"), compare=str(other)))
    assert not (tmp_path / "out").exists()
