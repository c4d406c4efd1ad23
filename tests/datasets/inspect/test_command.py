"""``headbench inspect`` writes picture and numbers, and refuses what cannot be shown."""

import json

import pytest

from headbench.bench.errors import InputError
from headbench.datasets.inspect.command import NUMBERS, PICTURE, InspectSettings, inspect

from ..lint.good_capture import read_rgb


def test_picture_numbers_and_text(capture, clip, tmp_path):
    calls = []
    settings = InspectSettings(str(capture.union), out=str(tmp_path / "out"), timesteps=1, cameras=2)
    findings = inspect(settings, lambda *arguments: calls.append(arguments))
    assert findings.passed
    assert calls
    picture = read_rgb(tmp_path / "out" / PICTURE)
    assert picture.shape[1] == 1600
    numbers = json.loads((tmp_path / "out" / NUMBERS).read_text())
    assert numbers["fingerprint"] == clip.fingerprint
    counts = {row["split"]: row["images"] for row in numbers["splits"]}
    assert counts == {"train": 36, "novel_view": 12, "self_reenactment": 40}
    held_out = [camera for camera in numbers["cameras"] if camera["held_out"]]
    assert [camera["id"] for camera in held_out] == ["222200037"]
    assert held_out[0]["principal_point_off_centre_px"] == pytest.approx([0.4, -0.6])
    assert held_out[0]["position_m"] == pytest.approx(clip.cameras["222200037"].center)
    assert "novel_view" in findings.text
    assert "FREE" in findings.text
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [NUMBERS, PICTURE]


@pytest.mark.parametrize("changes", [{"timesteps": 0}, {"cameras": 0}, {"clip": "nothing"}])
def test_what_cannot_be_shown_is_refused_before_any_writing(capture, tmp_path, changes):
    settings = {"clip": str(capture.union), "out": str(tmp_path / "out")} | changes
    with pytest.raises(InputError):
        inspect(InspectSettings(**settings))
    assert not (tmp_path / "out").exists()
