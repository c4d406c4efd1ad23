"""Trains every native method for GPUs on the pretended device, and ends and continues a training there; prints JSON.

A process of its own, as torch has to know the device before the first gradient.
``python -m headbench.tests.methods.pretended_training FOLDER [METHOD ...]``.
"""

import json
import sys
from pathlib import Path

import numpy as np

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.runner.config import RunOptions
from headbench.bench.runner.run import trained

from ..small_run import small_run
from . import pretended
from .pretended_trial import METHODS

ITERATIONS = 6


class Killed(Exception):
    """Ends a training."""


def killing(done: int, total: int, note: str = "") -> None:
    """Progress that ends a training after its third iteration."""
    if total == ITERATIONS and done == 3:
        raise Killed


def fit(job, folder, device, progress=no_progress, iterations=ITERATIONS):
    method = job.method.create()
    budget = Budget(iterations=iterations)
    return method.fit(job.form.clip, folder, budget, device=device, seed=0, progress=progress)


def trial(job, folder) -> dict:
    """Differences of a frame between devices and through a kill, and what an iteration asks of device and host."""
    key = min(job.clip.splits["novel_view"])
    form = job.form.clip
    camera, pose = form.cameras[job.form.key(key).camera], form.poses[job.form.key(key).timestep]
    expected = fit(job, folder / "cpu", "cpu").render(camera, pose).rgb
    with pretended.pretended() as device:
        totals = []
        for iterations in (2, ITERATIONS):
            device.counts.clear()
            avatar = fit(job, folder / f"of{iterations}", pretended.DEVICE, iterations=iterations)
            totals.append(device.counts.copy())
        found = avatar.render(camera, pose).rgb
        try:
            fit(job, folder / "killed", pretended.DEVICE, killing)
        except Killed:
            pass
        resumed = fit(job, folder / "killed", pretended.DEVICE).render(camera, pose).rgb
    return {
        "difference": float(np.abs(found - expected).max()),
        "resumed": float(np.abs(resumed - found).max()),
        **{name: (totals[1][name] - totals[0][name]) / (ITERATIONS - 2) for name in ("operations", "waits")},
    }


def main() -> None:
    """See the module."""
    pretended.register()
    folder = Path(sys.argv[1])
    run = small_run(folder, *(sys.argv[2:] or METHODS))
    _, jobs = trained(run.root, (), RunOptions(), folder / "kept")
    print(json.dumps({job.method.spec.name: trial(job, folder / job.method.spec.name) for job in jobs}))


if __name__ == "__main__":
    main()
