"""From what a method declares to the clip it gets: which steps run, in which order, and the way back."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.contracts import Camera, no_progress
from headbench.bench.engine.adaptation import MethodNeeds, plan
from headbench.bench.errors import InputError
from headbench.bench.specs import ResolutionRule
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.refit.refit import BlockFitter
from headbench.datasets.steps import for_method
from headbench.datasets.steps.for_method import Alignment, PixelBox, align_clip, clip_for_method, take_box

from ..head.toy import toy_head

OTHER = toy_head(16, version="other", expression_size=5, shape_size=4, eyelids=True)


@pytest.fixture
def heads(tmp_path):
    save_head(tmp_path / "other.npz", OTHER)
    return {"other": str(tmp_path / "other.npz")}


def pretend_refit(clip, target, *, folder, progress):
    """Stands in for the optimiser: coefficients that tell timesteps apart."""
    size = target.expression_basis.shape[2]
    poses = {
        t: replace(
            pose, head_model=target.version, expression=np.full(size, t / 7), eyelids=np.array([0.1, t / 3])
        )
        for t, pose in clip.poses.items()
    }
    shape, offset = np.arange(target.shape_basis.shape[2]) / 3, np.zeros_like(target.template)
    identity = {"head": target, "shape": shape, "static_offset": offset}
    return SimpleNamespace(clip=clip.derive("pretend_refit", {}, poses=poses, **identity))


def adapted(clip, folder, heads=None, **needs):
    return clip_for_method(clip, MethodNeeds(**needs), heads or {})(folder, no_progress)


def test_a_method_without_needs_gets_no_adaptation(clip):
    assert plan(clip, MethodNeeds(), {}) is None
    assert plan(clip, MethodNeeds(head_models=(clip.head.version,)), {}) is None
    assert plan(clip, MethodNeeds(monocular=True), {}) is not None


def test_needs_that_change_nothing_give_the_clip_itself(clip, tmp_path):
    form = adapted(clip, tmp_path, resolution=ResolutionRule(speed_size=(64, 64)))
    key = clip.splits["novel_view"][0]
    assert form.clip is clip
    assert form.key(key) == key
    render = np.random.default_rng(0).random((64, 48, 3)).astype(np.float32)
    assert np.array_equal(form.restore(key, render), render)


def test_all_steps_in_their_order(clip, tmp_path, heads, monkeypatch):
    monkeypatch.setattr(for_method, "refit", pretend_refit)
    form = adapted(
        clip,
        tmp_path / "kept",
        heads,
        head_models=("other",),
        monocular=True,
        resolution=ResolutionRule(square="pad", size=(128, 128)),
    )
    added = [step.name for step in form.clip.steps[len(clip.steps) :]]
    assert added == ["pretend_refit", "align_resolution", "as_single_video"]
    for key in [*clip.splits["train"], *clip.splits["self_reenactment"]]:
        own = form.key(key)
        pose, camera = form.clip.poses[own.timestep], form.clip.cameras[own.camera]
        assert pose.head_model == "other"
        assert pose.expression[0] == key.timestep / 7
        assert (camera.width, camera.height) == (128, 128)
        image = form.clip.image(own)
        assert image.shape == (128, 128, 3)
        # Twice as large and back: what a perfect method would be scored with.
        back = form.restore(key, image.astype(np.float32) / 255)
        # Noise of 52 levels, which cubic and means soften.
        assert np.abs(255 * back - clip.image(key)).mean() < 12
        assert back.shape == (64, 48, 3)


def test_a_refit_goes_on_where_it_was(clip, tmp_path, heads, monkeypatch):
    """With the real refit: what it left in the folder is used by a second call, and gives the same clip."""
    first = adapted(clip, tmp_path, heads, head_models=("other",)).clip
    assert first.head.version == "other"
    assert all(pose.head_model == "other" for pose in first.poses.values())
    monkeypatch.setattr(BlockFitter, "fit", lambda *_: pytest.fail("fitted again"))
    second = adapted(clip, tmp_path, heads, head_models=("other",)).clip
    assert second.fingerprint == first.fingerprint
    for timestep, pose in first.poses.items():
        assert np.array_equal(second.poses[timestep].expression, pose.expression)
    with pytest.raises(pytest.fail.Exception):
        adapted(clip, tmp_path / "elsewhere", heads, head_models=("other",))


def test_what_cannot_be_done_is_said_before_any_work(clip, heads, tmp_path):
    for needs, at_hand, said in (
        ({"head_models": ("flame2020",)}, heads, r"--set heads.flame2020=PATH"),
        (
            {"head_models": ("flame2020",)},
            {"flame2020": heads["other"]},
            "expected 'flame2020', found 'other'",
        ),
        ({"head_models": ("x",)}, {"x": str(Path(tmp_path) / "none.npz")}, "no such file"),
        ({"resolution": ResolutionRule(divide=60)}, {}, "at least 60 pixels"),
    ):
        with pytest.raises(InputError, match=said):
            clip_for_method(clip, MethodNeeds(**needs), at_hand)


WHITE = (1.0, 1.0, 1.0)
RULES = {
    "reduced": ResolutionRule(divide=4),
    "enlarged": ResolutionRule(multiply=3),
    "native input of 2K": ResolutionRule(divide=4, multiply=4),
    "square": ResolutionRule(square="pad", size=(512, 512)),
    "cropped": ResolutionRule(square="crop", size=(300, 300)),
    "uneven": ResolutionRule(size=(123, 287)),
    "remainder": ResolutionRule(divide=3),
}


def view(width=240, height=344):
    K = np.array([[700.0, 0, 117.3], [0, 705.0, 180.9], [0, 0, 1]])
    return Camera("c", width, height, K, np.eye(4))


def project(camera, point):
    x, y, z = camera.K @ np.asarray(point)
    return np.array([x / z, y / z])


def disc(camera, point, radius):
    """A dark disc at a point's projection on white, its rim a pixel soft: coverage by 8x8 samples per pixel."""
    centre = project(camera, point)
    samples = (np.arange(8) + 0.5) / 8
    y = (np.arange(camera.height)[:, None] + samples).ravel()
    x = (np.arange(camera.width)[:, None] + samples).ravel()
    inside = (x[None] - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2 < radius**2
    coverage = inside.reshape(camera.height, 8, camera.width, 8).mean((1, 3))
    return np.repeat((1 - 0.8 * coverage)[..., None], 3, axis=2).astype(np.float32)


def centroid(image):
    darkness = (1 - image.astype(float)).mean(axis=2)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    return np.array([(darkness * x).sum(), (darkness * y).sum()]) / darkness.sum()


@pytest.mark.parametrize("name", RULES)
def test_a_disc_lands_where_the_aligned_camera_projects_it(name):
    point = (0.0137, -0.0211, 1.0)
    camera = view()
    image = disc(camera, point, 21.3)
    assert np.abs(centroid(image) - project(camera, point)).max() < 0.01
    plan = Alignment.of((camera.width, camera.height), RULES[name])
    aligned = plan.camera(camera)
    moved = plan.image(image, WHITE)
    assert moved.shape == (aligned.height, aligned.width, 3)
    assert (aligned.width, aligned.height) == plan.aligned_size
    assert np.abs(centroid(moved) - project(aligned, point)).max() < 0.01
    assert np.abs(centroid(plan.restore(moved, WHITE)) - project(camera, point)).max() < 0.01


def test_padding_to_a_square_is_undone_to_the_bit():
    image = np.random.default_rng(0).random((40, 27, 3)).astype(np.float32)
    plan = Alignment.of((27, 40), ResolutionRule(square="pad"))
    padded = plan.image(image, (0.2, 0.4, 0.6))
    assert padded.shape == (40, 40, 3)
    assert padded[0, 0] == pytest.approx([0.2, 0.4, 0.6])
    assert np.array_equal(plan.restore(padded, WHITE), image)


def test_a_crop_gives_back_background_where_it_cut():
    image = np.zeros((10, 6, 3), np.float32)
    plan = Alignment.of((6, 10), ResolutionRule(square="crop"))
    restored = plan.restore(plan.image(image, WHITE), WHITE)
    assert restored[:, 0, 0].tolist() == [1, 1, 0, 0, 0, 0, 0, 0, 1, 1]


def test_enlarging_is_undone_by_block_means():
    """What a method renders four times as large is scored by the mean of each block."""
    plan = Alignment.of((30, 20), ResolutionRule(multiply=4))
    render = np.random.default_rng(1).random((80, 120, 3)).astype(np.float32)
    expected = render.reshape(20, 4, 30, 4, 3).mean((1, 3))
    assert np.abs(plan.restore(render, WHITE) - expected).max() < 1e-6


def test_a_rule_that_changes_nothing_moves_nothing(clip):
    assert Alignment.of((64, 64), ResolutionRule(square="pad", size=(64, 64))).moves == ()
    for rule in (ResolutionRule(), ResolutionRule(size=(48, 64), speed_size=(9, 9))):
        assert align_clip(clip, rule) is clip


def test_a_box_outside_the_image_is_background():
    box = take_box(np.zeros((3, 3, 1), np.float32), PixelBox(5, 5, 2, 2), (0.5,))
    assert (box == 0.5).all()


def test_wrong_sizes_are_refused():
    plan = Alignment.of((30, 20), ResolutionRule(multiply=2))
    with pytest.raises(InputError, match="render, size: expected 60x40, found 30x20"):
        plan.restore(np.zeros((20, 30, 3), np.float32), WHITE)


# ------------------------------------------------------------------ clips


def test_a_clip_is_resized_when_read(clip):
    aligned = align_clip(clip, ResolutionRule(divide=2))
    key = clip.splits["train"][3]
    image, mask = aligned.image(key), aligned.mask(key)
    truth = clip.image(key).reshape(32, 2, 24, 2, 3).astype(float).mean((1, 3))
    assert image.dtype == np.uint8
    assert np.abs(image - truth).max() <= 0.5 + 1e-4
    assert np.abs(mask - clip.mask(key).reshape(32, 2, 24, 2).astype(float).mean((1, 3))).max() <= 0.5 + 1e-4
    camera, before = aligned.cameras[key.camera], clip.cameras[key.camera]
    assert (camera.width, camera.height) == (24, 32)
    assert camera.K[:2] == pytest.approx(before.K[:2] / 2)
    assert not image.flags.writeable
    assert aligned.image(key) is image
    step = aligned.steps[-1]
    assert (step.name, step.input_fingerprint) == ("align_resolution", clip.fingerprint)
    assert (step.parameters["rule"]["divide"], step.parameters["sizes"]) == (2, ["48x64 to 24x32"])
    third = align_clip(clip, ResolutionRule(divide=3))
    assert len({clip.fingerprint, aligned.fingerprint, third.fingerprint}) == 3


def test_padding_has_no_coverage(clip):
    aligned = align_clip(clip, ResolutionRule(square="pad"))
    key = clip.splits["train"][0]
    assert aligned.mask(key).shape == (64, 64)
    assert not aligned.mask(key)[:, :8].any()
    assert (aligned.image(key)[:, :8] == 255).all()
    assert np.array_equal(aligned.image(key)[:, 8:56], clip.image(key))
