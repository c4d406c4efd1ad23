"""Reads and draws an avatar of every native method for GPUs on the pretended device; prints JSON.

A process of its own: torch has to know the device before the first gradient.
``python -m headbench.tests.methods.pretended_trial FOLDER``.
"""

import contextlib
import importlib
import json
import sys
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.contracts import Budget, StagedAvatar
from headbench.bench.runner.config import RunOptions
from headbench.bench.runner.run import load, trained
from headbench.methods.shared.schedule import Timeline

from ..small_run import small_run
from . import pretended

METHODS = ("ga", "gbs", "gha", "ours")
TRAINED = ("ga", "gbs", "ours")
"""Methods of which the loss is counted: gha's surface has to be waited for."""
COUNTED = ("operations", "waits")
WHITE = (1.0, 1.0, 1.0)


def trial(job) -> dict:
    """How far a frame of an avatar is from that of the CPU, and what one of a new pose asks of the device and of the host.

    By stage: "rasterize" is what the reference renderer asks for, in whose place a GPU has gsplat's kernels; what is before it
    is "deform" of avatars that have no stages.
    """
    keys = sorted(job.clip.splits["novel_view"])
    form = job.form.clip
    frames = [(form.cameras[k.camera], form.poses[k.timestep]) for k in map(job.form.key, keys)]
    (camera, pose), other = (
        frames[0],
        next(f for f in frames if not np.array_equal(*_expressions(f, frames[0]))),
    )
    expected = load(job).render(camera, pose)
    with pretended.pretended() as device:
        avatar = job.method.create().load(job.cell.avatar, device=pretended.DEVICE)
        avatar.render(*other)
        device.counts.clear()
        with _Stages(device.counts) as stages:
            if isinstance(avatar, StagedAvatar):
                found = avatar.read_back(avatar.draw(camera, pose, WHITE, stages.end))
            else:
                found = avatar.render(camera, pose)
        stages.end("read_back")
    return {
        "difference": float(np.abs(found.rgb - expected.rgb).max()),
        "drawn": float(expected.alpha.mean()),
        "stages": stages.found,
    }


class _Done(Exception):
    """Ends a training after its loss."""


def loss(job, folder: Path) -> dict:
    """What the loss of an image asks for when its timestep is known, by stage as in `trial`; "loss" follows the renderer."""
    found = {}

    def train(trainable, sampler, fit, *, published_length, **ignored):
        trainable.begin(Timeline(100, published_length))
        for _ in range(2):
            device.counts.clear()
            with _Stages(device.counts) as stages:
                trainable.loss(60, sampler(60))
        stages.end("loss")
        found.update(stages.found)
        raise _Done

    budget = Budget(iterations=100)
    where = {"device": pretended.DEVICE, "seed": 0, "progress": lambda *report: None}
    with pytest.MonkeyPatch.context() as patch, pretended.pretended() as device, contextlib.suppress(_Done):
        patch.setattr("headbench.methods.shared.splat_training.train", train)
        job.method.create().fit(job.form.clip, folder / job.method.spec.name, budget, **where)
    return found


def _expressions(one, other):
    return one[1].expression, other[1].expression


class _Stages:
    """Operations and waits of each stage; the reference renderer is one wherever it is called."""

    def __init__(self, counts: Counter):
        self._counts, self._before = counts, Counter()
        self._module = importlib.import_module("headbench.methods.splats.rasterize")
        self._reference = self._module.rasterize_reference
        self.found = defaultdict(Counter)

    def __enter__(self):
        self._module.rasterize_reference = self._drawn
        return self

    def __exit__(self, *error):
        self._module.rasterize_reference = self._reference

    def end(self, stage):
        now = Counter({name: self._counts[name] for name in COUNTED})
        self.found[stage].update(now - self._before)
        self._before = now

    def _drawn(self, request):
        self.end("deform")
        rendering = self._reference(request)
        self.end("rasterize")
        return rendering


def main() -> None:
    """See the module."""
    pretended.register()
    folder = Path(sys.argv[1])
    run = small_run(folder, *METHODS)
    _, jobs = trained(run.root, (), RunOptions(), folder / "kept")
    found = {}
    for job in jobs:
        name = job.method.spec.name
        found[name] = trial(job) | ({"loss": loss(job, folder / "fits")} if name in TRAINED else {})
    print(json.dumps(found))


if __name__ == "__main__":
    main()
