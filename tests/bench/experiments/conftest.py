from pathlib import Path

import pytest

from headbench.bench.engine import run as runner

from ...world import run_on


@pytest.fixture
def balls(monkeypatch):
    """The plug-in with the ball avatars, importable by name."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.setattr(runner, "write_reports", lambda folder: [])
    import ball_plugin

    return ball_plugin


@pytest.fixture
def ball_run(balls, tmp_path):
    """Makes a finished run of some of the ball methods on two subjects."""

    def make(*methods):
        named = (f"ball_plugin:{name}" for name in methods)
        how = {"subjects": ("ball-a", "ball-bee"), "reader": "ball_plugin:READER"}
        return run_on(tmp_path / "data", tmp_path / "run", *named, **how).root

    return make
