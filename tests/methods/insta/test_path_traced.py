"""INSTA learns a path-traced frame by heart at its demo preset: a wrong or missing gradient anywhere keeps it from that."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.run_config import resolve_method
from headbench.datasets.ga_reader import read_capture
from headbench.datasets.synthetic.capture import synthesize
from headbench.methods.specs import INSTA

ENOUGH_DB = 35.0


@pytest.mark.slow
def test_one_path_traced_frame_is_learnt_by_heart(tmp_path):
    (union,) = synthesize(tmp_path / "capture", cameras=2, timesteps=8, size=(96, 136), workers=1)
    clip = read_capture(union)
    key = clip.splits["train"][-1]
    single = replace(clip, splits={**clip.splits, "train": (key,)})
    avatar = (
        resolve_method(INSTA, "demo", {})
        .create()
        .fit(single, tmp_path / "avatar", Budget(iterations=600), device="cpu", seed=0, progress=no_progress)
    )
    frame = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], clip.background)
    error = frame.rgb - clip.image(key).astype(np.float32) / 255
    psnr = -10 * np.log10(np.mean(error**2))
    print(f"{psnr:.1f} dB")
    assert psnr >= ENOUGH_DB
