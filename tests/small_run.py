"""Runs small enough for tests: on toy plug-ins, and of methods trained for a few iterations on a tiny capture."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from headbench.bench.engine import run as runner
from headbench.bench.engine.config import RunConfig
from headbench.bench.engine.store import RunFolder

from .datasets.head.toy import toy_head
from .datasets.tiny_capture import make_plan, rig, write_tiny_capture
from .methods.flashavatar.small import SMALL as SMALL_FLASHAVATAR
from .methods.gha.small import SMALL as SMALL_GHA
from .methods.insta.small import SMALL as SMALL_INSTA
from .methods.rgbavatar.small import SMALL as SMALL_RGBAVATAR

ITERATIONS = {"budget": {"iterations": 2}}
SETTINGS: dict[str, dict[str, Any]] = {
    "flashavatar": {**ITERATIONS, **SMALL_FLASHAVATAR},
    "ga": ITERATIONS,
    "gbs": {**ITERATIONS, "samples": 200, "teeth_samples": 20},
    "gha": {**ITERATIONS, **SMALL_GHA, "start_steps": 2, "motion_steps": 2},
    "insta": {**ITERATIONS, **SMALL_INSTA},
    "rgbavatar": {**ITERATIONS, **SMALL_RGBAVATAR},
    "ours": {
        **ITERATIONS,
        "planes": {"resolution": 8},
        "lines": {"resolution": 4, "channels": 2},
        "hidden": 8,
    },
}
"""Two iterations of the smallest form of each method."""


def run_on(data: Path, out: Path, *methods: str, subjects: tuple[str, ...] = (), **changes: Any) -> RunFolder:
    """A finished run of ``methods`` at the preset smoke, measured by PSNR unless ``changes`` says otherwise.

    It writes no reports. ``subjects`` are folders to be made in ``data``, which readers of toy plug-ins take for captures.
    """
    for subject in subjects:
        (data / subject).mkdir(parents=True, exist_ok=True)
    settings = {name: SETTINGS[name] for name in methods if name in SETTINGS}
    chosen = {"preset": "smoke", "metrics": ("psnr",), "settings": settings, **changes}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "write_reports", lambda out: [])
        runner.run(RunConfig(data=str(data), out=str(out), methods=methods, **chosen))
    return RunFolder(out)


def rows_of(run: RunFolder) -> pd.DataFrame:
    """All rows of a run."""
    return pd.read_parquet(run.rows)


def small_run(folder: Path, *methods: str) -> RunFolder:
    """A run of methods, each trained for two iterations, beside its capture ``data``."""
    capture = write_tiny_capture(folder / "data", make_plan(head=toy_head(16, version="procedural2020")))
    return run_on(capture.union, folder / "out", *methods)


def small_capture(folder: Path) -> None:
    """Write a capture of five timesteps and two cameras, of the head model that every method takes as it is."""
    lengths = {"FREE": 2, "EMO-1-shout+laugh": 2, "SEN-01-cramp_small_danger": 1}
    head = toy_head(16, version="procedural2020")
    plan = make_plan(
        lengths=lengths,
        cameras=rig(24, 32, 12.3, 15.1)[:2],
        head=head,
        static_offset=np.zeros_like(head.template),
    )
    write_tiny_capture(folder, plan)
