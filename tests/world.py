"""The small world that tests share: a capture, a clip and runs, built once in a process and copied where a test writes."""

import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from headbench.bench.engine import run as runner
from headbench.bench.engine.config import RunConfig
from headbench.bench.engine.store import RunFolder

from .datasets.head.toy import toy_head
from .datasets.tiny_capture import TinyCapture, make_plan, write_tiny_capture
from .methods.flashavatar.small import SMALL as SMALL_FLASHAVATAR
from .methods.gha.small import SMALL as SMALL_GHA
from .methods.insta.small import SMALL as SMALL_INSTA
from .methods.rgbavatar.small import SMALL as SMALL_RGBAVATAR
from .methods.toy_clip import ToyClip, toy_clip

ITERATIONS = {"budget": {"iterations": 2}}
SETTINGS = {
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


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """What is built once; removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="headbench-tests-")


def forget() -> None:
    """Remove what was built; a worker of a parallel run ends without the interpreter's own clearing."""
    if _folder.cache_info().currsize:
        _folder().cleanup()


def place(name: str) -> Path:
    """A path for what is built once."""
    return Path(_folder().name, name)


@cache
def capture() -> TinyCapture:
    """A capture that tests only read: two training sequences and FREE, three cameras, a toy head with teeth."""
    return write_tiny_capture(place("capture"))


@cache
def procedural_capture() -> TinyCapture:
    """As `capture`, with a head whose version names the procedural one, as methods and readers of videos want it."""
    return write_tiny_capture(place("procedural"), make_plan(head=toy_head(16, version="procedural2020")))


@cache
def clip() -> ToyClip:
    """A clip in memory that tests only read."""
    return toy_clip(toy_head(16), timesteps=3, cameras=3, width=28, height=36)


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


METHODS = ("mean-image", "ga", "gbs", "gha", "insta", "ours")


@cache
def finished() -> RunFolder:
    """A run of `METHODS` that tests only read, its capture ``data`` beside it; the trained ones have two iterations."""
    return small_run(place("finished"), *METHODS)


def small_run(folder: Path, *methods: str) -> RunFolder:
    """A run of methods, each trained for two iterations, beside its capture ``data``."""
    return run_on(procedural_capture().copied(folder / "data").union, folder / "out", *methods)
