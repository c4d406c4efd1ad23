"""Each splat method can learn one frame by heart: a wrong or missing gradient anywhere keeps it from that."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.run_config import resolve_method
from headbench.methods.specs import GA, GBS, OURS

ITERATIONS = 500
ENOUGH_DB = 45.0
OVER = {
    "ours": {"balanced_sampling": False},  # one timestep has no classes
    "gbs": {"sample_spacing": 0.5},  # the toy's texture changes from triangle to triangle
}


@pytest.mark.slow
@pytest.mark.parametrize("spec", [GA, GBS, OURS], ids=lambda spec: spec.name)
def test_one_frame_is_learnt_by_heart(clip, tmp_path, spec):
    method = resolve_method(spec, "demo", OVER.get(spec.name, {})).create()
    key = clip.splits["train"][0]
    single = replace(clip, splits={**clip.splits, "train": (key,)})
    avatar = method.fit(
        single, tmp_path, Budget(iterations=ITERATIONS), device="cpu", seed=0, progress=no_progress
    )
    frame = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], clip.background)
    error = frame.rgb - clip.image(key).astype(np.float32) / 255
    assert -10 * np.log10(np.mean(error**2)) >= ENOUGH_DB
