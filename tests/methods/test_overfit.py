"""Methods can learn one frame by heart: a wrong or missing gradient anywhere keeps them from that."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine import adaptation
from headbench.bench.engine.adaptation import MethodNeeds
from headbench.bench.engine.config import resolve_method
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.synthetic.capture import synthesize
from headbench.methods.flashavatar.spec import FLASHAVATAR
from headbench.methods.ga.spec import GA
from headbench.methods.gbs.spec import GBS
from headbench.methods.gha.spec import GHA
from headbench.methods.insta.spec import INSTA
from headbench.methods.ours.spec import OURS
from headbench.methods.rgbavatar.spec import RGBAVATAR

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
