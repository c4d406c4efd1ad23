"""A run on toy plug-ins, small enough to see through."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench.engine import run as runner
from headbench.bench.engine.config import RunConfig
from headbench.bench.engine.store import RunFolder
from headbench.bench.rows import Rows

from ..world import place


@pytest.fixture
def toy(monkeypatch):
    """The toy plug-in, importable by name."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    import toy_plugin

    toy_plugin.FITS.clear()
    toy_plugin.ADAPTED.clear()
    toy_plugin.LISTS.clear()
    toy_plugin.WORKLOAD_SIZES.clear()
    return toy_plugin


@pytest.fixture
def subjects():
    """Whose captures there are."""
    return ("subject1",)


@pytest.fixture
def config(toy, tmp_path, monkeypatch, subjects):
    """Settings of a run that writes no reports."""
    monkeypatch.setattr(runner, "write_reports", lambda folder: [])
    for name in subjects:
        (tmp_path / "data" / name).mkdir(parents=True)
    return RunConfig(
        data=str(tmp_path / "data"),
        out=str(tmp_path / "run"),
        methods=("toy_plugin:METHOD",),
        preset="smoke",
        metrics=("psnr", "toy_plugin:FILES"),
        reader="toy_plugin:READER",
    )


FINISHED: dict[str, Path] = {}
"""Runs that tests copy, by their settings."""


@pytest.fixture
def finished(toy):
    """Put a finished run of a configuration into its folder: a copy, of a run made once. Return its rows."""

    def finished(config):
        captures = sorted(path.name for path in Path(config.data).iterdir())
        key = repr((replace(config, data="", out=""), captures))
        if key not in FINISHED:
            root = place(f"toy-{len(FINISHED)}")
            shutil.copytree(config.data, root / "data")
            runner.run(replace(config, data=str(root / "data"), out=str(root / "run")))
            FINISHED[key] = root / "run"
        shutil.copytree(FINISHED[key], config.out)
        toy.FITS.clear()
        return Rows.read(RunFolder(Path(config.out)).rows)

    return finished


@pytest.fixture
def run(config, finished):
    """The folder of a finished run."""
    finished(config)
    return Path(config.out)


@pytest.fixture
def cell(config):
    """The first subject's cell of the run."""
    return RunFolder(Path(config.out)).cell("subject1", "toy", 0)
