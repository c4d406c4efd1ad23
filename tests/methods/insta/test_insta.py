"""The method: learning, resuming, storing, and staying finite whatever is asked for."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.bench.configuration import build
from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.datasets.images import srgb_to_linear
from headbench.methods.insta import avatar as avatar_module
from headbench.methods.insta import kernel
from headbench.methods.insta.avatar import FIELD_FILE, SETTINGS_FILE, InstaAvatar
from headbench.methods.insta.method import Insta, color_loss, depth_loss, target_colors, to_linear, to_srgb
from headbench.methods.insta.spec import INSTA, InstaConfig

from ..toy_clip import check_frame, first_view
from .small import SMALL


def test_the_color_loss_is_hubers():
    color = torch.tensor([[0.5, 0.5, 0.5], [0.2, 0.0, 0.0]], requires_grad=True)
    target = torch.tensor([[0.45, 0.5, 0.5], [0.9, 0.0, 0.0]])
    weights = torch.tensor([1.0, 40.0])
    # Square below 0.1: d^2 / (2 delta). Linear above: |d| - delta / 2. Sum of three channels, mean of two rays; a fifth.
    expected = 0.2 * 0.5 * (0.05**2 / 0.2 + 40 * (0.7 - 0.05))
    loss = color_loss(color, target, weights, 0.1)
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    loss.backward()
    assert color.grad[1, 0].item() == pytest.approx(-0.2 * 0.5 * 40)


def test_rays_without_depth_count_for_nothing():
    distance = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    loss = depth_loss(distance, torch.tensor([1.5, torch.inf, 2.0]))
    assert loss.item() == pytest.approx(1.5 / 3)
    loss.backward()
    assert distance.grad.tolist() == pytest.approx([-1 / 3, 0, 1 / 3])


def test_linear_light_agrees_and_comes_back():
    values = torch.linspace(0, 1, 257, dtype=torch.float64)
    np.testing.assert_allclose(to_linear(values), srgb_to_linear(values.numpy()), atol=1e-12)
    torch.testing.assert_close(to_srgb(to_linear(values)), values, atol=1e-6, rtol=0)


@pytest.mark.parametrize("variant", ["paper", "official"])
def test_backgrounds_are_exchanged(variant):
    config = InstaConfig(target_variant=variant)
    own = torch.tensor([[0.8, 0.3, 0.1]])
    was, new = torch.tensor([1.0, 1.0, 1.0]), torch.tensor([[0.1, 0.9, 0.4]])
    for coverage, expected in ((1.0, own), (0.0, new)):
        alpha = torch.tensor([[coverage]])
        image = alpha * own + (1 - alpha) * was
        torch.testing.assert_close(target_colors(image, alpha, was, new, config), expected, atol=1e-6, rtol=0)
    alpha = torch.tensor([[0.25]])
    mixed = target_colors(alpha * own + (1 - alpha) * was, alpha, was, new, config)
    straight = alpha * own + (1 - alpha) * new
    if variant == "official":
        straight = to_srgb(alpha * to_linear(own) + (1 - alpha) * to_linear(new))
    torch.testing.assert_close(mixed, straight, atol=1e-5, rtol=0)


BUDGET = Budget(iterations=24)


def fit(clip, folder, progress=no_progress, seed=3, **more):
    config = InstaConfig(**{**SMALL, "checkpoint_every_s": 0.0, **more})
    return Insta(config).fit(clip, folder, BUDGET, device="cpu", seed=seed, progress=progress)


def content(avatar):
    return {path.name: path.read_bytes() for path in avatar.files()}


@pytest.fixture(scope="module")
def trained(clip, tmp_path_factory):
    folder = tmp_path_factory.mktemp("insta")
    return folder, fit(clip, folder)


def test_training_lowers_the_error_on_a_held_out_view(clip, tmp_path):
    config = InstaConfig(**{**SMALL, "learning_rate": 2e-2, "depth_weight": 0.0})
    key, errors = clip.splits["novel_view"][0], []
    for n in (1, 100):
        how = {"device": "cpu", "seed": 0, "progress": no_progress}
        avatar = Insta(config).fit(clip, tmp_path / str(n), Budget(iterations=n), **how)
        frame = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], clip.background)
        errors.append(np.square(frame.rgb - clip.image(key) / 255.0).mean())
    # The toy's texture changes from triangle to triangle, finer than so small a grid can tell: it ends at 0.68.
    assert errors[1] < 0.8 * errors[0]


def extreme_poses(pose, head):
    rng = np.random.default_rng(0)
    three = np.sign(rng.standard_normal(pose.expression.shape)).astype(np.float32) * 3
    yield replace(pose, expression=three, timestep=None)
    yield replace(pose, expression=-three, timestep=None)
    for jaw in (0.0, 1.5, -1.5, np.pi):
        yield replace(pose, jaw=np.array([jaw, 0, 0], np.float32), timestep=None)
    yield replace(pose, rotation=np.array([0, np.pi, 0], np.float32), timestep=None)
    yield replace(pose, translation=np.array([50, 0, 0], np.float32), timestep=None)


def test_extreme_poses_and_views_stay_finite_and_bounded(trained, clip, head):
    camera, pose = first_view(clip)
    size = camera.width, camera.height
    for extreme in extreme_poses(pose, head):
        check_frame(trained[1].render(camera, extreme), *size)
    within = np.eye(4)
    close = np.eye(4)
    close[2, 3] = 0.1
    for transform in (within, close, np.diag([1.0, -1, -1, 1])):
        check_frame(trained[1].render(replace(camera, world_to_camera=transform), pose), *size)


def test_without_the_kernel_an_avatar_looks_the_same(trained, clip, monkeypatch):
    camera, pose = first_view(clip)
    camera = camera.resized(3, 4)
    expected = trained[1].render(camera, pose)
    monkeypatch.setattr(kernel.KERNEL, "imported", ImportError("missing"))
    frame = InstaAvatar.read(trained[0], "cpu").render(camera, pose)
    assert expected.alpha.max() > 0.1
    # A sample between two triangles or at a cell's wall may go either way by rounding.
    assert np.abs(frame.rgb - expected.rgb).mean() < 1e-4
    assert np.abs(frame.alpha - expected.alpha).max() < 0.02


def test_large_images_are_rendered_in_parts(trained, clip, monkeypatch):
    camera, pose = first_view(clip)
    whole = trained[1].render(camera, pose)
    monkeypatch.setattr(avatar_module, "RAYS_AT_ONCE", 37)
    parts = trained[1].render(camera, pose)
    np.testing.assert_allclose(parts.rgb, whole.rgb, atol=1e-5)


DAMAGE = {
    FIELD_FILE: lambda path: path.write_bytes(b"nonsense"),
    SETTINGS_FILE: lambda path: path.write_bytes(b"nonsense"),
    "levles": lambda path: path.with_name(SETTINGS_FILE).write_text('{"levles": 3}'),
    "table": lambda path: change_array(path, "table", lambda array: array[:-1]),
    "density_0": lambda path: change_array(path, "density_0", lambda array: array * np.nan),
    "occupied": lambda path: change_array(path, "occupied", lambda array: array[:-1]),
}


def change_array(path, name, change):
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, name: change(arrays[name])})


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_files_are_refused_by_name(trained, tmp_path, name):
    shutil.copytree(trained[0], tmp_path / "copy")
    file = name if name in (FIELD_FILE, SETTINGS_FILE) else FIELD_FILE
    DAMAGE[name](tmp_path / "copy" / file)
    with pytest.raises(InputError, match=name):
        InstaAvatar.read(tmp_path / "copy", "cpu")


def test_no_regions_and_no_masks_are_trained(clip, tmp_path):
    bare = replace(clip.head, regions={})
    plain = replace(clip, head=bare, masks=dict.fromkeys(clip.masks))
    avatar = fit(plain, tmp_path)
    camera, pose = first_view(clip)
    check_frame(avatar.render(camera, pose), camera.width, camera.height)


def test_the_paper_preset_has_the_published_values():
    settings = dict(INSTA.presets["paper"])
    assert settings.pop("budget") == {"iterations": 20_000}
    config = build(InstaConfig, settings, "preset")
    assert (config.warp_variant, config.target_variant) == ("paper", "paper")
    assert (config.levels, config.level_features, config.log2_table) == (16, 8, 18)
    assert (config.learning_rate, config.betas) == (1.75e-3, (0.9, 0.99))
    assert (config.weight_decay, config.ema) == (1e-6, 0.95)
    assert (config.huber, config.mouth_weight, config.depth_weight) == (0.1, 40.0, 1.25)
    assert config.step == pytest.approx(3**0.5 / 1024)


def test_a_clip_with_masks_for_some_frames_is_refused(clip, tmp_path):
    keys = clip.splits["train"]
    masks = {key: (mask if key == keys[0] else None) for key, mask in clip.masks.items()}
    with pytest.raises(InputError, match="mask"):
        fit(replace(clip, masks=masks), tmp_path)


def test_a_pose_of_another_head_is_refused(trained, clip):
    camera, pose = first_view(clip)
    with pytest.raises(InputError, match="head_model"):
        trained[1].render(camera, replace(pose, head_model="another"))
