"""A run on a tiny capture in which methods are trained for a few iterations, for tests of what is done with avatars."""

from pathlib import Path

import pytest

from headbench.bench.runner import run as runner
from headbench.bench.runner.config import RunConfig
from headbench.bench.runner.store import RunFolder

from .datasets.head.toy import toy_head
from .datasets.tiny_capture import make_plan, write_tiny_capture
from .fuzz.samples import SETTINGS


def small_run(folder: Path, *methods: str) -> RunFolder:
    """The run, beside its capture ``data``; it writes no reports."""
    capture = write_tiny_capture(folder / "data", make_plan(head=toy_head(16, version="procedural2020")))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "write_reports", lambda out: [])
        runner.run(
            RunConfig(
                data=str(capture.union),
                out=str(folder / "out"),
                methods=methods,
                preset="smoke",
                metrics=("psnr",),
                settings={name: SETTINGS[name] for name in methods if name in SETTINGS},
            )
        )
    return RunFolder(folder / "out")
