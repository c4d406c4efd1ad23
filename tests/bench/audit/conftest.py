"""A finished run on toy plug-ins, one subject."""

import sys
from pathlib import Path

import pytest

from headbench.bench.runner import run as runner
from headbench.bench.runner.config import RunConfig


@pytest.fixture
def toy(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1])
    monkeypatch.setattr(runner, "write_reports", lambda folder: [])
    import toy_plugin

    yield toy_plugin
    sys.modules.pop("toy_plugin", None)


@pytest.fixture
def run(toy, tmp_path):
    """The folder of the run."""
    (tmp_path / "data" / "subject1").mkdir(parents=True)
    config = RunConfig(
        data=str(tmp_path / "data"),
        out=str(tmp_path / "run"),
        methods=("toy_plugin:METHOD",),
        preset="smoke",
        metrics=("psnr", "toy_plugin:FILES"),
        reader="toy_plugin:READER",
    )
    runner.run(config)
    return Path(config.out)
