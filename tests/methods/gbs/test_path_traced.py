"""From a path-traced capture to an avatar, by way of the refit and the single video."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench import adaptation
from headbench.bench.adaptation import MethodNeeds
from headbench.bench.contracts import Budget, no_progress
from headbench.bench.run_config import resolve_method
from headbench.datasets.ga_reader import read_capture
from headbench.datasets.specs import GA_LAYOUT
from headbench.datasets.synthetic.capture import synthesize
from headbench.methods.specs import GBS

ENOUGH_DB = 35.0


@pytest.mark.slow
def test_one_path_traced_frame_is_learnt_by_heart(tmp_path):
    (union,) = synthesize(tmp_path / "capture", cameras=2, timesteps=8, size=(96, 136), workers=1)
    needs = MethodNeeds.of(GBS)
    planned = adaptation.plan(read_capture(union), needs, GA_LAYOUT, {})
    assert planned is not None
    clip = adaptation.carry_out(planned, needs, tmp_path / "adapted", "adapting").clip
    assert clip.head.version == "procedural2020"
    key = clip.splits["train"][-1]
    single = replace(clip, splits={**clip.splits, "train": (key,)})
    avatar = (
        resolve_method(GBS, "demo", {})
        .create()
        .fit(single, tmp_path / "avatar", Budget(iterations=500), device="cpu", seed=0, progress=no_progress)
    )
    frame = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], clip.background)
    error = frame.rgb - clip.image(key) / 255.0
    assert -10 * np.log10(np.mean(error**2)) >= ENOUGH_DB
