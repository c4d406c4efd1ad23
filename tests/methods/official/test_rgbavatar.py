"""RGBAvatar's adapter: the video that their loader reads, the configuration of a run, renders read back by key."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from headbench.bench.errors import InputError
from headbench.datasets.steps.charted import packed_chart
from headbench.methods.official.spec import RGBAVATAR_OFFICIAL
from headbench.methods.rgbavatar.config import RGBAvatarConfig
from headbench.methods.rgbavatar.method import RGBAvatarTraining

from .helpers import BUDGET, check_tracked, export, fit, read_tracked
from .repository import CONFIG, make_rgbavatar_repository

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


def test_a_run_of_the_published_length_has_published_values(method, video_clip, tmp_path):
    work, _ = export(method, video_clip, tmp_path / "work")
    steps = RGBAVATAR_OFFICIAL.presets["paper"]["budget"]["iterations"]
    run = type("Run", (), {"budget": replace(BUDGET, iterations=steps), "clip": video_clip})
    method.train_command(run, work)
    published, found = (yaml.safe_load(text) for text in (CONFIG, (work.program / "config.yaml").read_text()))
    assert found["train"] == published["train"]


def test_frames_hold_pose_and_camera_in_the_heads_frame(exported, video_clip):
    work, images = exported
    assert len(list((work.input / "head/checkpoint").iterdir())) == len(images)
    for number, (place, key) in enumerate(images.items()):
        assert place == f"input/head/images/{number:05d}.png"
        found = read_tracked(work.input / f"head/checkpoint/{number:05d}.frame")
        assert check_tracked(found, video_clip, key) < 1e-3


def test_the_texture_chart_is_theirs(exported, method):
    work, _ = exported
    name = "data/FLAME2020/flame_uv.npz"
    assert (work.program / name).read_bytes() == (Path(method.config.checkout) / name).read_bytes()


@pytest.mark.parametrize(
    ("more", "expected"),
    {(1, 0): "l_eyelid.npy has.*Refit the capture to FLAME 2020", (0, 1): "flame_uv.npz has"}.items(),
)
def test_another_topology_than_flames_is_refused(method, tmp_path, video_clip, more, expected):
    sizes = len(video_clip.head.template) + more[0], len(video_clip.head.faces) + more[1]
    folder = tmp_path / "other"
    commit = make_rgbavatar_repository(folder, *sizes)
    method.config = replace(method.config, checkout=str(folder), commit=commit)
    with pytest.raises(InputError, match=expected):
        method.check(video_clip, BUDGET)


def test_another_topology_has_its_chart_with_the_shim(method, video_clip, tmp_path):
    """Its own chart, with the texels and the initial size of the native method; without a chart it is refused."""
    folder = tmp_path / "other"
    commit = make_rgbavatar_repository(folder, len(video_clip.head.template) + 1, len(video_clip.head.faces))
    values = {"checkout": str(folder), "commit": commit, "device": "cpu-shim", "samples": 500}
    method.config = replace(method.config, **values, motion="root", values=("position_lr_final=0.1",))
    with pytest.raises(InputError, match="uv: expected texture coordinates"):
        method.check(video_clip, BUDGET)
    uv = packed_chart(video_clip.head.template, video_clip.head.faces)
    clip = replace(video_clip, head=replace(video_clip.head, uv=uv))
    work, _ = export(method, clip, tmp_path / "work")
    chart = np.load(work.program / "data/FLAME2020/flame_uv.npz")
    np.testing.assert_array_equal(chart["vt"][chart["ft"]], uv)
    method.train_command(type("Run", (), {"budget": BUDGET, "clip": clip}), work)
    found = yaml.safe_load((work.program / "config.yaml").read_text())
    points = RGBAvatarTraining(clip, RGBAvatarConfig(samples=500), "cpu", 0).points
    texels = found["model"]["tex_size"]
    across = 0.5 * np.abs(np.linalg.det(uv[:, 1:] - uv[:, :1])).sum() * texels**2
    assert across == pytest.approx(500, rel=0.1)
    scale = 0.0008 * (60_000 / len(points.triangles)) ** 0.5
    assert found["model"]["init_scaling"] == pytest.approx(scale)
    assert found["dataset"] == {"retarget_neck": False, "pin_memory": True}
    assert found["train"]["recon"]["position_lr_final"] == 0.1


def test_the_order_is_that_of_the_native_batches(method, video_clip, tmp_path):
    run = type("Run", (), {"budget": replace(BUDGET, iterations=5), "clip": video_clip, "seed": 3})
    native = RGBAvatarTraining(video_clip, RGBAvatarConfig(samples=100), "cpu", 3)
    expected = [native._batches.batch(step) for step in range(1, 6)]
    assert list(method.batches(run)) == expected
    assert method.image_name("input/head/images/00012.png") == "12"


def test_files_missing_in_the_checkout_are_named(method, repository, video_clip):
    (repository[0] / "data/FLAME2020/flame_uv.npz").unlink()
    with pytest.raises(InputError, match="none of data/FLAME2020/flame_uv.npz"):
        method.check(video_clip, BUDGET)


def test_a_configuration_of_another_form_is_refused(method, repository, video_clip, tmp_path):
    path = repository[0] / "config/offline.yaml"
    path.write_text(CONFIG.replace("blend_start_iter", "blend_from"))
    with pytest.raises(InputError, match="blend_start_iter: expected one entry, found 0"):
        fit(method, video_clip, tmp_path / "a")
