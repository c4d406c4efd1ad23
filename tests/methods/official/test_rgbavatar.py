"""RGBAvatar's adapter: the video that their loader reads, the configuration of a run, renders read back by key."""

from dataclasses import replace

import yaml

from headbench.methods.rgbavatar.method import RGBAvatarTraining
from headbench.methods.rgbavatar.spec import RGBAvatarConfig

from .helpers import BUDGET, check_tracked, read_tracked
from .repository import CONFIG

NAME = "rgbavatar"


def test_the_published_configuration_is_scaled_to_the_run(trained):
    folder, _ = trained(NAME)
    found = yaml.safe_load((folder / "config.yaml").read_text())
    assert (found["data_dir"], found["output_dir"]) == ("../input", "../model")
    assert (found["train"].pop("iteration"), found["train"].pop("batch_size")) == (200, 10)
    assert found["train"]["recon"].pop("blend_start_iter") == 10
    assert found["train"]["recon"].pop("position_lr_max_steps") == 120
    published = yaml.safe_load(CONFIG)
    for name in ("batch_size", "iteration"):
        del published["train"][name]
    for name in ("blend_start_iter", "position_lr_max_steps"):
        del published["train"]["recon"][name]
    assert {**found, "data_dir": "", "output_dir": ""} == {**published, "data_dir": "", "output_dir": ""}


def test_frames_hold_pose_and_camera_in_the_heads_frame(exported, video_clip):
    work, images = exported
    assert len(list((work.input / "head/checkpoint").iterdir())) == len(images)
    for number, (place, key) in enumerate(images.items()):
        assert place == f"input/head/images/{number:05d}.png"
        found = read_tracked(work.input / f"head/checkpoint/{number:05d}.frame")
        assert check_tracked(found, video_clip, key) < 1e-3


def test_the_order_is_that_of_the_native_batches(method, video_clip, tmp_path):
    run = type("Run", (), {"budget": replace(BUDGET, iterations=5), "clip": video_clip, "seed": 3})
    native = RGBAvatarTraining(video_clip, RGBAvatarConfig(samples=100), "cpu", 3)
    expected = [native._batches.batch(step) for step in range(1, 6)]
    assert list(method.batches(run)) == expected
    assert method.image_name("input/head/images/00012.png") == "12"
