"""A real run on toy plug-ins, two subjects, scored by PSNR; and a way to make it worse on purpose."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from headbench.bench.io.images import read_png, write_png
from headbench.bench.runner import run as runner
from headbench.bench.runner.config import RunConfig
from headbench.bench.runner.store import RunFolder

SUBJECTS = ("subject1", "subject2")


@pytest.fixture
def toy(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1])
    monkeypatch.setattr(runner, "write_reports", lambda folder: [])
    import toy_plugin

    return toy_plugin


@pytest.fixture
def config(toy, tmp_path):
    for name in SUBJECTS:
        (tmp_path / "data" / name).mkdir(parents=True)
    return RunConfig(
        data=str(tmp_path / "data"),
        out=str(tmp_path / "run"),
        methods=("toy_plugin:METHOD",),
        preset="smoke",
        metrics=("psnr", "toy_plugin:FILES"),
        reader="toy_plugin:READER",
    )


@pytest.fixture
def run(config):
    """The folder of a finished run."""
    runner.run(config)
    return Path(config.out)


@pytest.fixture
def remeasured(config):
    """Change every stored frame of a subject's task by a function, and measure the run again."""

    def remeasured(subject, task, change):
        cell = RunFolder(Path(config.out)).cell(subject, "toy", 0)
        frames = sorted((cell.folder / "renders" / task).glob("*.png"))
        assert frames
        for path in frames:
            write_png(path, change(read_png(path)))
        rendered = cell.step("digests")
        files = {**rendered["files"], **cell.digests(frames)}
        cell.finish("digests", rendered["fingerprint"], files=files)
        runner.run(config)
        return pd.read_parquet(RunFolder(Path(config.out)).rows)

    return remeasured


@pytest.fixture(autouse=True)
def _forget_the_toys():
    yield
    sys.modules.pop("toy_plugin", None)


def brightened(levels):
    """A change of all pixels by whole levels."""
    return lambda image: np.clip(image.astype(int) + levels, 0, 255).astype(np.uint8)
