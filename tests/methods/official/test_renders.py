"""Which image of an official program shows which frame. GaussianAvatars' order is tested with `headbench evaluate`."""

from types import SimpleNamespace

import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.methods.official.workplace import gaussian_blendshapes, insta


def test_gaussianblendshapes_numbers_the_last_350_frames(tmp_path):
    keys = [FrameKey("s", "video", timestep, "0") for timestep in range(400)]
    clip = SimpleNamespace(subject="s", splits={"train": keys[:50]}, excluded=dict.fromkeys(keys[50:], "why"))
    for name, count in (("test", 350), ("seq", 400)):
        made = tmp_path / name / "split_40000"
        made.mkdir(parents=True)
        for index in range(count):
            (made / f"pred_{index:05d}.png").touch()
        found = gaussian_blendshapes(tmp_path, clip, {})
        assert {render.truth.name for render in found.values()} >= {"gt_00000.png"}
        for key in keys[-count:]:
            index = key.timestep - (400 - count) if name == "test" else key.timestep
            assert found[key].image.name == f"pred_{index:05d}.png" or name == "seq"
        assert len(found) == count
    (tmp_path / "seq/split_40000/pred_00399.png").unlink()
    with pytest.raises(InputError, match="400 images.*found 399"):
        gaussian_blendshapes(tmp_path, clip, {})


def test_insta_numbers_the_frames_that_are_held_out(tmp_path):
    parts = ("video",) * 4 + ("video-held-out",) * 3
    keys = [FrameKey("s", sequence, timestep, "0") for timestep, sequence in enumerate(parts)]
    splits = {"train": keys[:3], "self_reenactment": keys[4:6]}
    clip = SimpleNamespace(subject="s", splits=splits, excluded={keys[3]: "why", keys[6]: "why"})
    (tmp_path / "overlay").mkdir()
    for index in range(3):
        (tmp_path / "overlay" / f"{index:05d}.png").touch()
    found = insta(tmp_path, clip, {})
    assert {key: render.image.name for key, render in found.items()} == {
        key: f"{index:05d}.png" for index, key in enumerate(keys[4:])
    }
    (tmp_path / "overlay/00002.png").unlink()
    with pytest.raises(InputError, match="3 images.*transforms_test.json, found 2"):
        insta(tmp_path, clip, {})
    with pytest.raises(InputError, match="expected overlay, as the program leaves it"):
        insta(tmp_path / "overlay", clip, {})
