"""Runs on toy plug-ins, by any executor."""

import os
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pandas as pd
import pytest

from headbench.bench.engine import run as runner
from headbench.bench.engine.store import RunFolder
from headbench.bench.io.files import write_json


@pytest.fixture
def subjects():
    return ("subject1", "subject2")


@pytest.fixture
def config(config, monkeypatch):
    """Two methods, one of which fails, on two subjects."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    metrics = ("psnr", "toy_plugin:ERROR", "toy_plugin:FILES")
    return replace(config, methods=("toy_plugin:METHOD", "toy_plugin:FAILING"), metrics=metrics)


@pytest.fixture
def rows_of():
    """Run something; return the rows on disk."""

    def rows_of(config, execution=None):
        runner.run(config, execution)
        return pd.read_parquet(RunFolder(Path(config.out)).rows)

    return rows_of


@pytest.fixture
def command(tmp_path):
    """Start `headbench run` of a configuration in a process of its own, which finds the toy plug-ins."""
    started = []

    def command(config, *options):
        file = tmp_path / "config.json"
        write_json(file, asdict(config))
        folders = (Path(__file__).parent, Path(__file__).parents[1])
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}
        words = [sys.executable, "-m", "headbench.bench.start", "run", "--config", str(file), *options]
        process = subprocess.Popen(
            words, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        started.append(process)
        return process

    yield command
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()
