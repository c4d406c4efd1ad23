"""Trains and draws with every native method for GPUs on the pretended device; prints JSON.

A process of its own, as torch has to know the device before the first gradient.
``python -m headbench.tests.methods.pretended_trial FOLDER``.
"""

import importlib
import json
import sys
from collections import Counter
from pathlib import Path
from unittest.mock import patch

import numpy as np

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine.config import RunOptions
from headbench.bench.engine.plan import trained

from ..world import small_run
from . import pretended

METHODS = ("flashavatar", "ga", "gbs", "gha", "ours", "rgbavatar")
ITERATIONS = 3


def trial(job, folder) -> dict:
    """How far frames are from those of the CPU after training there and here, and what one asks of the device and the host.

    The reference renderer, in whose place a GPU has gsplat's kernels, is not counted.
    """
    form, method = job.form, job.method.create()
    frames = [
        (form.clip.cameras[key.camera], form.clip.poses[key.timestep])
        for key in map(form.key, sorted(job.clip.splits["novel_view"]))
    ]
    budget, rasterize = Budget(ITERATIONS), importlib.import_module("headbench.methods.splats.rasterize")

    def fitted(device):
        return method.fit(form.clip, folder / device, budget, device=device, seed=0, progress=no_progress)

    expected = fitted("cpu").render(*frames[0])
    reference, inside = rasterize.rasterize_reference, Counter()

    def drawn(request):
        before = device.counts.copy()
        rendering = reference(request)
        inside.update(device.counts - before)
        return rendering

    with pretended.pretended() as device:
        there = fitted(pretended.DEVICE).render(*frames[0])
        avatar = method.load(folder / "cpu", device=pretended.DEVICE)
        avatar.render(*frames[-1])
        device.counts.clear()
        with patch.object(rasterize, "rasterize_reference", drawn):
            found = avatar.render(*frames[0])
        counts = device.counts - inside
    return {
        "difference": float(np.abs(found.rgb - expected.rgb).max()),
        "trained": float(np.abs(there.rgb - expected.rgb).max()),
        "drawn": float(expected.alpha.mean()),
        "waits": counts["waits"],
        "operations": counts["operations"],
    }


def main() -> None:
    """See the module."""
    pretended.register()
    folder = Path(sys.argv[1])
    run = small_run(folder, *METHODS)
    _, jobs = trained(run.root, (), RunOptions(), folder / "kept")
    print(json.dumps({job.method.spec.name: trial(job, folder / job.method.spec.name) for job in jobs}))


if __name__ == "__main__":
    main()
