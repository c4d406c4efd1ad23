"""The mechanism of every native method: seen in its avatars, and gone with the ablation that its spec names."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.bench.contracts import Budget, Clip, no_progress
from headbench.bench.engine import adaptation
from headbench.bench.engine.adaptation import MethodNeeds
from headbench.bench.engine.cell import training_poses
from headbench.bench.engine.config import resolve_method
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.synthetic.capture import synthesize
from headbench.methods.flashavatar.spec import FLASHAVATAR
from headbench.methods.ga.spec import GA
from headbench.methods.gbs.spec import GBS
from headbench.methods.gha.spec import GHA
from headbench.methods.insta.spec import INSTA
from headbench.methods.ours.method import OursAvatar
from headbench.methods.ours.spec import OURS
from headbench.methods.rgbavatar.spec import RGBAVATAR
from headbench.metrics.mechanism import dynamic_splats

from .ours.toy import store
from .test_conformance import SPECS, resolved

OVER = {
    "flashavatar": {"samples": 2_000},
    "ours": {"sampling": {"balanced": False}},  # one timestep has no clusters
    "rgbavatar": {"samples": 2_000},
    "gbs": {"sample_spacing": 0.5},  # the toy's texture changes from triangle to triangle
}


def psnr_by_heart(spec, clip, key, folder, iterations, settings):
    """PSNR in dB of a frame that was all a method saw, in so many iterations of its demo preset with seed 0."""
    single = replace(clip, splits={**clip.splits, "train": (key,)})
    method, budget = resolve_method(spec, "demo", settings).create(), Budget(iterations=iterations)
    avatar = method.fit(single, folder, budget, device="cpu", seed=0, progress=no_progress)
    frame = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], clip.background)
    error = frame.rgb - clip.image(key).astype(np.float32) / 255
    return -10 * np.log10(np.mean(error**2))


@pytest.mark.parametrize(
    ("iterations", "enough_db"), [(120, 27.0), pytest.param(500, 45.0, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("spec", [FLASHAVATAR, GA, GBS, OURS, RGBAVATAR], ids=lambda spec: spec.name)
def test_one_frame_is_learnt_by_heart(clip, tmp_path, spec, iterations, enough_db):
    settings = OVER.get(spec.name, {})
    assert psnr_by_heart(spec, clip, clip.splits["train"][0], tmp_path, iterations, settings) >= enough_db


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spec", "height", "iterations", "settings"),
    [(GBS, 136, 500, {}), (GHA, 138, 600, {"expression_noise": 0.0}), (INSTA, 136, 600, {})],
    ids=lambda value: getattr(value, "name", None),
)
def test_single_frame_overfit_of_a_synthetic_capture(tmp_path, spec, height, iterations, settings):
    """Adapted to each method."""
    (union,) = synthesize(tmp_path / "capture", cameras=2, timesteps=8, size=(96, height), workers=1)
    clip = read_capture(union)
    needs = MethodNeeds.of(spec)
    planned = adaptation.plan(clip, needs, {})
    if planned is not None:
        clip = adaptation.apply(planned, needs, tmp_path / "adapted", "adapting").clip
    assert spec is not GBS or clip.head.version == "procedural2020"
    key = clip.splits["train"][-1]
    assert psnr_by_heart(spec, clip, key, tmp_path / "avatar", iterations, settings) >= 35.0


METHODS = [name for name, spec in SPECS.items() if spec.mechanism]


def ranges(name, clip: Clip, folder, settings):
    method = resolved(name, **settings)
    avatar = method.create().fit(clip, folder, method.budget, device="cpu", seed=0, progress=no_progress)
    details = dynamic_splats(avatar, training_poses(clip)).details
    return [value for key, value in details.items() if key.endswith("_range")]


def test_every_trained_native_method_has_one():
    assert {*METHODS} == {name for name, spec in SPECS.items() if not spec.trivial}


@pytest.mark.parametrize("name", METHODS)
def test_its_ablation_turns_it_off(name, clip, tmp_path):
    spec = SPECS[name]
    assert max(ranges(name, clip, tmp_path / "plain", {})) > 1e-6
    assert (
        max(ranges(name, clip, tmp_path / "off", spec.ablations[spec.mechanism.ablation]), default=0) < 1e-6
    )


def test_lines_change_what_is_drawn(clip, tmp_path):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    workload = training_poses(clip)
    drawn = np.stack([avatar.splats(pose).opacities for _, pose in workload])
    expected = np.ptp(drawn, axis=0)
    found = dynamic_splats(avatar, workload)
    assert found.details["opacity_range"] == pytest.approx(expected.max(), abs=1e-6)
    inside = avatar.line_offsets.inside  # nearly all: the lines' box is that of the head
    assert found.details["splats"] == len(inside) > 0.9 * len(expected)
    assert found.value == pytest.approx(100 * (expected[inside] > 0.05).mean())
    assert 1 < found.value < 100


@torch.no_grad()
def test_lines_without_weights_are_dead(clip, tmp_path):
    folder = store(clip, tmp_path, change=lambda values: values["line_gain_2"].zero_())
    found = dynamic_splats(OursAvatar.read(folder, "cpu"), training_poses(clip))
    assert found.value == found.details["opacity_range"] == found.details["dynamic_penalised"] == 0


def test_penalised_are_splats_on_still_triangles(clip, tmp_path):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    for _, pose in training_poses(clip)[:2]:
        still = pose.expression * 0
        rest = avatar.changes(
            type(pose)(**{**vars(pose), "expression": still, "jaw": still[:3], "eyes": np.zeros(6)})
        )
        assert rest.penalised.all()
        wide = avatar.changes(type(pose)(**{**vars(pose), "expression": 1e3 + still}))
        assert not wide.penalised.all()


def test_the_head_model_stage_of_ours_has_no_lines(clip, tmp_path, monkeypatch):
    avatar = OursAvatar.read(store(clip, tmp_path), "cpu")
    order, lines = [], avatar.line_offsets
    monkeypatch.setattr(
        avatar, "line_offsets", lambda coefficients: order.append("lines") or lines(coefficients)
    )
    key = clip.splits["train"][0]
    avatar.draw(clip.cameras[key.camera], clip.poses[key.timestep], (1.0, 1.0, 1.0), order.append)
    assert order[:3] == ["drive", "lines", "deform"]
