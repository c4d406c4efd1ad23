"""How well a method learns a single frame: a wrong or missing gradient anywhere keeps it from learning it by heart."""

from dataclasses import replace

import numpy as np

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.runner.config import resolve_method


def psnr_by_heart(spec, clip, key, folder, iterations, **settings):
    """PSNR in dB of a frame that was all a method saw, in so many iterations of its demo preset with seed 0."""
    single = replace(clip, splits={**clip.splits, "train": (key,)})
    avatar = (
        resolve_method(spec, "demo", settings)
        .create()
        .fit(single, folder, Budget(iterations=iterations), device="cpu", seed=0, progress=no_progress)
    )
    frame = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], clip.background)
    error = frame.rgb - clip.image(key).astype(np.float32) / 255
    return -10 * np.log10(np.mean(error**2))
