from pathlib import Path

import pytest

from headbench.bench.runner import run as runner
from headbench.bench.runner.config import RunConfig


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
        for subject in ("ball-a", "ball-bee"):
            (tmp_path / "data" / subject).mkdir(parents=True, exist_ok=True)
        config = RunConfig(
            data=str(tmp_path / "data"),
            out=str(tmp_path / "run"),
            methods=tuple(f"ball_plugin:{name}" for name in methods),
            metrics=("psnr",),
            reader="ball_plugin:READER",
            preset="smoke",
        )
        runner.run(config)
        return tmp_path / "run"

    return make
