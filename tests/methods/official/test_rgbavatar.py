"""RGBAvatar's adapter: the video that their loader reads, the configuration of a run, renders read back by key."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from headbench.bench.errors import InputError
from headbench.bench.io.documents import read_json
from headbench.datasets.head.subject import PosedSubject
from headbench.datasets.steps.charted import packed_chart
from headbench.methods.official.config import RGBAvatarOfficialConfig
from headbench.methods.official.method import TRAINING_LOG
from headbench.methods.official.rgbavatar import method as implementation
from headbench.methods.official.spec import RGBAVATAR_OFFICIAL
from headbench.methods.rgbavatar.config import RGBAvatarConfig
from headbench.methods.rgbavatar.method import RGBAvatarTraining

from .repository import (
    BUDGET,
    check_tracked,
    export,
    fit,
    read_tracked,
    rendered,
    views,
    with_an_odd_size,
)
from .rgbavatar_repository import CONFIG, make_rgbavatar_repository

NAME = "rgbavatar"


def test_frames_are_rendered_under_their_keys_on_any_ground(avatar, video_clip, monkeypatch):
    monkeypatch.setattr(implementation, "PART", 8)  # more than one call for a camera's frames
    assert {path.name for path in avatar.files()} == {"model.ply", "config.yaml", "subject.npz"}
    several = with_an_odd_size(views(video_clip, "self_reenactment", "novel_view", "train"))
    for wanted, ground in ((several, (0.0, 0.5, 1.0)), (views(video_clip, "novel_view"), (1.0, 1.0, 1.0))):
        found = rendered(avatar, wanted, ground)
        motions = PosedSubject.of(video_clip).motions([pose for _, pose in wanted.values()])
        for (key, (camera, pose)), motion in zip(wanted.items(), motions):
            frame = found[key]
            assert frame.alpha == pytest.approx(0.6)
            shift = (camera.world_to_camera @ motion)[0, 3]
            shown = 60 + np.array([20 * pose.expression[0], 200 * -np.sin(pose.jaw[0]), 100 * shift])
            corner = np.array([camera.K[0, 0], camera.K[0, 2], 255])  # 300 is not 300 - 256
            for pixel, levels in ((frame.rgb[1, 1], np.clip(shown, 0, 153)), (frame.rgb[0, 0], corner)):
                expected = np.clip(np.floor(levels) / 255 + 0.4 * np.array(ground), 0, 1)
                assert np.abs(pixel - expected).max() < 1.01 / 255


def test_the_published_configuration_is_scaled_to_the_run(method, repository, video_clip, tmp_path):
    calls = []
    fit(method, video_clip, tmp_path / "a", lambda done, total, note="": calls.append(done))
    frames = len(video_clip.splits["train"])
    assert calls[-1] == frames + 20
    assert frames + 7 in calls, "steps of ten images"
    log = (tmp_path / "a" / TRAINING_LOG).read_text()
    assert "train_offline.py --subject head --work_name headbench" in log
    found = yaml.safe_load((tmp_path / "a" / "config.yaml").read_text())
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
    record = read_json(tmp_path / "a" / "training.json")
    assert record["official"]["commit"] == repository[1]
    assert record["leaks"] == []
    assert any("8 directions is padded" in line for line in record["differences"])


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


def test_the_texture_chart_is_theirs(exported, repository):
    work, _ = exported
    name = "data/FLAME2020/flame_uv.npz"
    assert (work.program / name).read_bytes() == (repository[0] / name).read_bytes()


@pytest.mark.parametrize(
    ("more", "expected"),
    {(1, 0): "l_eyelid.npy has.*Refit the capture to FLAME 2020", (0, 1): "flame_uv.npz has"}.items(),
)
def test_another_topology_than_flames_is_refused(method, repository, video_clip, more, expected):
    sizes = len(video_clip.head.template) + more[0], len(video_clip.head.faces) + more[1]
    folder = repository[0].with_name("other")
    commit = make_rgbavatar_repository(folder, *sizes)
    method.config = replace(method.config, checkout=str(folder), commit=commit)
    with pytest.raises(InputError, match=expected):
        method.check(video_clip, BUDGET)


def test_another_topology_has_its_chart_with_the_shim(method, repository, video_clip, tmp_path):
    """Its own chart, with the texels and the initial size of the native method; without a chart it is refused."""
    folder = repository[0].with_name("other")
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


@pytest.mark.parametrize("value", ["tex_size", "iteration=5", "tex_size=9"])
def test_entries_that_the_adapter_writes_cannot_be_given(value):
    with pytest.raises(ValueError, match="values must be NAME=VALUE of other entries than data_dir"):
        RGBAvatarOfficialConfig(values=(value,))
