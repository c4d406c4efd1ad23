"""A run of two subjects, and a way to make it worse on purpose."""

from pathlib import Path

import pandas as pd
import pytest

from headbench.bench.engine import run as runner
from headbench.bench.engine.store import RunFolder
from headbench.bench.io.images import read_png, write_png


@pytest.fixture
def subjects():
    return ("subject1", "subject2")


@pytest.fixture
def remeasured(config):
    """Change every stored frame of a subject's task by a function, and measure the run again."""

    def remeasured(subject, task, change):
        folder = RunFolder(Path(config.out))
        cell = folder.cell(subject, "toy", 0)
        frames = sorted((cell.folder / "renders" / task).glob("*.png"))
        assert frames
        for path in frames:
            write_png(path, change(read_png(path)))
        cell.update(measured=None)
        runner.run(config)
        return pd.read_parquet(folder.rows)

    return remeasured
