"""``headbench export compact`` on an avatar trained on a capture on disk."""

import json
import re
import shutil

import pytest

from headbench.bench.engine.stored import avatar_folder, load_avatar
from headbench.bench.errors import InputError
from headbench.methods.avatars.compact.codecs import compact_avatar
from headbench.methods.avatars.settings import CompactSettings

from ....world import finished


@pytest.fixture(scope="module")
def trained():
    """Capture and folder of an avatar."""
    run = finished()
    return run.read_manifest().configuration.data, avatar_folder(run.cell("901", "ours", 0).folder)


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
    capture, avatar = trained
    other = shutil.copytree(avatar, tmp_path / "other")
    record = json.loads((other / "avatar.json").read_text())
    (other / "avatar.json").write_text(json.dumps({**record, "subject": "902"}))
    with pytest.raises(InputError, match="subject: expected '902', found '901'"):
        compact_avatar(CompactSettings(str(other), out=str(tmp_path / "out"), compare=str(capture)))
    assert not (tmp_path / "out").exists()
