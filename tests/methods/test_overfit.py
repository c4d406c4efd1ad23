"""Each splat method can learn one frame by heart: a wrong or missing gradient anywhere keeps it from that."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.methods.configs import GAConfig, OursConfig, SplatTraining
from headbench.methods.ga import GA
from headbench.methods.ours import Ours
from headbench.methods.specs import GA as GA_SPEC
from headbench.methods.specs import OURS as OURS_SPEC

ITERATIONS = 500
ENOUGH_DB = 45.0  # both reach 54


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "config", "spec"),
    [(GA, GAConfig, GA_SPEC), (Ours, OursConfig, OURS_SPEC)],
    ids=["ga", "ours"],
)
def test_one_frame_is_learnt_by_heart(clip, tmp_path, method, config, spec):
    settings = {name: value for name, value in spec.presets["demo"].items() if name != "budget"}
    settings["splats"] = SplatTraining(**settings["splats"])
    key = clip.splits["train"][0]
    single = replace(clip, splits={**clip.splits, "train": (key,)})
    if method is Ours:
        settings["balanced_sampling"] = False  # one timestep has no classes
    avatar = method(config(**settings)).fit(
        single, tmp_path, Budget(iterations=ITERATIONS), device="cpu", seed=0, progress=no_progress
    )
    frame = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], clip.background)
    error = frame.rgb - clip.image(key).astype(np.float32) / 255
    assert -10 * np.log10(np.mean(error**2)) >= ENOUGH_DB
