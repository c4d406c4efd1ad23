"""From what a method declares to the clip it gets: which steps run, in which order, and the way back."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.contracts import no_progress
from headbench.bench.engine.adaptation import MethodNeeds, plan
from headbench.bench.errors import InputError
from headbench.bench.specs import ResolutionRule
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.refit.refit import BlockFitter
from headbench.datasets.steps import for_method
from headbench.datasets.steps.for_method import clip_for_method

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
