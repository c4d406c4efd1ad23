"""Reads and draws an avatar of every native method on the pretended device; prints JSON.

A process of its own: torch has to know the device before the first gradient.
``python -m headbench.tests.methods.pretended_trial FOLDER``. Training is not tried: torch's guard of devices written in Python
ends the process in the backward pass.
"""

import json
import sys
from pathlib import Path

import numpy as np

from headbench.bench.runner.config import RunOptions
from headbench.bench.runner.run import load, trained

from ..small_run import small_run
from . import pretended

METHODS = ("ga", "gbs", "gha", "insta", "ours")


def trial(job) -> dict:
    """How far a frame of an avatar is from that of the CPU, and what a second frame asks of the device and of the host."""
    key = min(job.clip.splits["novel_view"])
    form = job.form.clip
    camera, pose = form.cameras[job.form.key(key).camera], form.poses[job.form.key(key).timestep]
    expected = load(job).render(camera, pose)
    with pretended.pretended() as device:
        avatar = job.method.create().load(job.cell.avatar, device=pretended.DEVICE)
        avatar.render(camera, pose)
        device.counts.clear()
        found = avatar.render(camera, pose)
    counts = {name: device.counts[name] for name in ("operations", "waits")}
    difference = float(np.abs(found.rgb - expected.rgb).max())
    return {"difference": difference, "drawn": float(expected.alpha.mean()), **counts}


def main() -> None:
    """See the module."""
    pretended.register()
    folder = Path(sys.argv[1])
    run = small_run(folder, *METHODS)
    _, jobs = trained(run.root, (), RunOptions(), folder / "kept")
    print(json.dumps({job.method.spec.name: trial(job) for job in jobs}))


if __name__ == "__main__":
    main()
