import shutil
from functools import cache
from pathlib import Path

import pytest

from headbench.bench.engine import run as runner

from ...world import place, run_on


@cache
def _finished(methods, subjects):
    """A run that tests copy."""
    folder = place("-".join(("balls", *methods, *subjects)).replace(":", "."))
    run_on(folder / "data", folder / "run", *methods, subjects=subjects, reader="ball_plugin:READER")
    return folder


@pytest.fixture
def balls(monkeypatch):
    """The plug-in with the ball avatars, importable by name."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.setattr(runner, "write_reports", lambda folder: [])
    import ball_plugin

    return ball_plugin


@pytest.fixture
def no_sheets(monkeypatch):
    """Leave out the drawing of contact sheets, which takes longer than all else that runs on balls do."""
    monkeypatch.setattr(
        "headbench.reports.contact_sheet.write_sheet", lambda path, *args, **how: path.touch()
    )


@pytest.fixture
def run_of(balls, tmp_path):
    """Makes a finished run of some methods on balls, its captures beside it."""

    def make(*methods, subjects=("ball-a", "ball-bee"), folder=tmp_path):
        shutil.copytree(_finished(methods, subjects), folder, dirs_exist_ok=True)
        return folder / "run"

    return make


@pytest.fixture
def ball_run(run_of):
    """Makes a finished run of some of the ball methods on two subjects."""
    return lambda *methods: run_of(*(f"ball_plugin:{name}" for name in methods))
