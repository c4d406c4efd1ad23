"""RGBAvatar's adapter: the video that their loader reads, the configuration of a run, renders read back by key."""

import re
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import yaml

from headbench.bench.errors import InputError
from headbench.bench.io.documents import read_json
from headbench.bench.io.images import read_pixels
from headbench.datasets.head.subject import PosedSubject
from headbench.methods.official import needs
from headbench.methods.official.config import RGBAvatarOfficialConfig
from headbench.methods.official.method import TRAINING_LOG, check_export
from headbench.methods.official.rgbavatar import method as implementation
from headbench.methods.official.spec import RGBAVATAR_OFFICIAL

from .repository import (
    BUDGET,
    check_killed_training,
    check_tracked,
    export,
    fit,
    read_tracked,
    renders,
    views,
)
from .rgbavatar_repository import CONFIG, RGBAvatarStandIn, make_rgbavatar_repository


@pytest.fixture
def repository(tmp_path, video_clip):
    head = video_clip.head
    folder = tmp_path / "repository"
    return folder, make_rgbavatar_repository(folder, len(head.template), len(head.faces))


@pytest.fixture
def method(repository):
    return RGBAvatarStandIn(RGBAvatarOfficialConfig(str(repository[0]), sys.executable, repository[1]))


def test_frames_are_rendered_under_their_keys_on_any_ground(avatar, video_clip, monkeypatch):
    monkeypatch.setattr(implementation, "PART", 8)  # more than one call for a camera's frames
    assert {path.name for path in avatar.files()} == {"model.ply", "config.yaml", "subject.npz"}
    several = views(video_clip, "self_reenactment", "novel_view", "train")
    odd = next(iter(several))
    several[odd] = (replace(several[odd][0], width=30), several[odd][1])  # and one of another size
    for wanted, ground in ((several, (0.0, 0.5, 1.0)), (views(video_clip, "novel_view"), (1.0, 1.0, 1.0))):
        done: list[int] = []
        found = dict(avatar.render_listed(wanted, ground, partial(_note, done)))
        assert found.keys() == wanted.keys()
        assert done == sorted(done)
        assert done[-1] == len(wanted)
        motions = PosedSubject.of(video_clip).motions([pose for _, pose in wanted.values()])
        for (key, (camera, pose)), motion in zip(wanted.items(), motions):
            frame = found[key]
            assert frame.rgb.shape == (camera.height, camera.width, 3)
            assert frame.alpha == pytest.approx(0.6)
            shift = (camera.world_to_camera @ motion)[0, 3]
            shown = 60 + np.array([20 * pose.expression[0], 200 * -np.sin(pose.jaw[0]), 100 * shift])
            corner = np.array([camera.K[0, 0], camera.K[0, 2], 255])  # 300 is not 300 - 256
            for pixel, levels in ((frame.rgb[1, 1], np.clip(shown, 0, 153)), (frame.rgb[0, 0], corner)):
                expected = np.clip(np.floor(levels) / 255 + 0.4 * np.array(ground), 0, 1)
                assert np.abs(pixel - expected).max() < 1.01 / 255


def _note(done, count, total, note=""):
    done.append(count)


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
    method.train_command(run, method.inspect(), work)
    published, found = (yaml.safe_load(text) for text in (CONFIG, (work.program / "config.yaml").read_text()))
    assert found["train"] == published["train"]
    assert set(RGBAVATAR_OFFICIAL.presets) == {"smoke", "demo", "fast", "paper"}


def test_frames_hold_pose_and_camera_in_the_heads_frame(exported, video_clip):
    work, images = exported
    assert len(list((work.input / "head/checkpoint").iterdir())) == len(images)
    for number, (place, key) in enumerate(images.items()):
        assert place == f"input/head/images/{number:05d}.png"
        found = read_tracked(work.input / f"head/checkpoint/{number:05d}.frame")
        assert check_tracked(found, video_clip, key) < 1e-3


def test_images_times_their_alpha_are_the_frames_on_black(exported, video_clip):
    work, images = exported
    check_export(work, images, video_clip)
    assert set(images.values()) == set(video_clip.splits["train"])
    for place, key in images.items():
        pixels = read_pixels(work.root / place).astype(float)
        share = video_clip.masks[key][..., None] / 255
        assert np.array_equal(pixels[..., 3:], video_clip.masks[key][..., None])
        on_black = video_clip.images[key][..., ::-1] - (1 - share) * 255 * video_clip.background
        assert np.abs(pixels[..., :3] * share - np.clip(on_black, 0, 255 * share)).max() < 0.51


def test_head_model_and_eyelids_are_the_clips_own(exported, repository, video_clip):
    work, _ = exported
    data = work.program / "data/FLAME2020"
    for index, side in enumerate("lr"):
        assert np.array_equal(np.load(data / f"{side}_eyelid.npy"), video_clip.head.eyelid_basis[..., index])
        assert not np.load(repository[0] / f"data/FLAME2020/{side}_eyelid.npy").any()
    assert (data / "flame_uv.npz").read_bytes() == (
        repository[0] / "data/FLAME2020/flame_uv.npz"
    ).read_bytes()


@pytest.mark.parametrize(
    ("behaviour", "expected"),
    {"crash": "exit code 1.*out of memory", "no ply": "no whole avatar.*model.ply"}.items(),
)
def test_a_training_that_fails_says_so(method, video_clip, faults_are_found, tmp_path, behaviour, expected):
    faults_are_found({behaviour: expected}, lambda: fit(method, video_clip, tmp_path / "a").files())


def test_a_killed_training_starts_again_on_its_export(method, video_clip, behave, tmp_path):
    log = check_killed_training(method, video_clip, behave, tmp_path / "a")
    found = re.findall(r"^finds (\w+)", log, re.MULTILINE)
    assert found == ["False", "False"], "nothing of the killed training is left"


def test_renders_that_are_not_what_was_listed_are_found(avatar, faults_are_found, video_clip):
    faults = {
        "crash in rendering": "exit code 1.*out of memory",
        "one too few": r"lacks 1 of 6 renders, first 000001.png \(toy/",
        "other size": "expected 28x36 pixels, found 27x36",
        "no coverage": "expected colours and coverage",
    }
    faults_are_found(faults, lambda: renders(avatar, video_clip))


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ("mask", "a mask"),
        ("intrinsics", "camera 01: expected size and intrinsics of camera 00"),
        ("skew", "no skew"),
        ("frames", "expected 10 training frames or more.*found 9"),
        ("topology", "l_eyelid.npy has.*Refit the capture to FLAME 2020"),
        ("triangles", "flame_uv.npz has"),
        ("basis", "at most 100 directions"),
    ],
)
def test_clips_that_their_code_cannot_take_are_refused(method, repository, video_clip, case, expected):
    cameras, train = video_clip.cameras, video_clip.splits["train"]
    if case == "mask":
        clip = replace(video_clip, masks=dict.fromkeys(video_clip.masks))
    elif case in ("intrinsics", "skew"):
        K = cameras["01"].K + ([[1, 0, 0], [0, 0, 0], [0, 0, 0]] if case == "intrinsics" else 0)
        other = "01" if case == "intrinsics" else "02"
        K = K if case == "intrinsics" else K + [[0, 1, 0], [0, 0, 0], [0, 0, 0]]
        clip = replace(video_clip, cameras={**cameras, other: replace(cameras[other], K=K)})
    elif case == "frames":
        clip = replace(video_clip, splits={**video_clip.splits, "train": train[:9]})
    elif case == "basis":
        basis = np.zeros((len(video_clip.head.template), 3, 101))
        clip = replace(video_clip, head=replace(video_clip.head, expression_basis=basis))
    else:
        clip = video_clip
        vertices, triangles = len(clip.head.template), len(clip.head.faces)
        sizes = (vertices + 1, triangles) if case == "topology" else (vertices, triangles + 1)
        folder = repository[0].with_name("other")
        commit = make_rgbavatar_repository(folder, *sizes)
        method.config = replace(method.config, checkout=str(folder), commit=commit)
    with pytest.raises(InputError, match=expected):
        method.check(clip, BUDGET)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"commit": "0" * 40}, "expected commit 000000000000, found commit"),
        ({"checkout": "/nowhere"}, "no such folder.*git clone.*gapszju/RGBAvatar"),
        ({"python": ""}, "settings.rgbavatar-official.python="),
        ({"device": "cpu-shim"}, "device: expected cuda"),
        ({"order": "native"}, "order: expected published"),
    ],
)
def test_faults_of_settings_are_named_before_any_work(method, video_clip, changes, expected):
    method.config = replace(method.config, **changes)
    with pytest.raises(InputError, match=expected):
        method.check(video_clip, BUDGET)


def test_files_missing_in_the_checkout_are_named(method, repository, video_clip):
    (repository[0] / "data/FLAME2020/flame_uv.npz").unlink()
    with pytest.raises(InputError, match="none of data/FLAME2020/flame_uv.npz"):
        method.check(video_clip, BUDGET)


def test_a_configuration_of_another_form_is_refused(method, repository, video_clip, tmp_path):
    path = repository[0] / "config/offline.yaml"
    path.write_text(CONFIG.replace("blend_start_iter", "blend_from"))
    with pytest.raises(InputError, match="blend_start_iter: expected one entry, found 0"):
        fit(method, video_clip, tmp_path / "a")


def test_doctor_names_checkout_environment_and_gpu(method, repository, monkeypatch):
    assert [need.found for need in needs.rgbavatar(RGBAvatarOfficialConfig(), "cpu")] == ["", ""]
    monkeypatch.setattr(needs, "RGBAvatarOfficial", RGBAvatarStandIn)
    found = [*needs.rgbavatar(method.config, "cpu")]
    assert found[0].found.endswith(repository[1][:12])
    assert found[1].found.startswith("Python 3")
    with_torch = replace(RGBAvatarStandIn.repository, modules=("torch",))
    monkeypatch.setattr(RGBAvatarStandIn, "repository", with_torch)
    (_, environment) = needs.rgbavatar(method.config, "cpu")
    assert "CUDA build of PyTorch" in environment.remedy
    assert "cpu-shim" not in environment.remedy, "the shim does not support this code"
    compile(implementation.RGBAVATAR_REPOSITORY.trial, "trial", "exec")
    assert RGBAVATAR_OFFICIAL.monocular
    assert RGBAVATAR_OFFICIAL.head_models == ("flame2020",)
