import itertools
from pathlib import Path

import pytest

from headbench.bench import runner
from headbench.bench.run_config import RunConfig
from headbench.bench.specs import MetricSpec
from headbench.bench.store import Row, to_frame

PSNR = MetricSpec("psnr", "PSNR", "dB", True, 2, "m:psnr")
LPIPS = MetricSpec("lpips", "LPIPS", "", False, 3, "m:lpips")
SIZE = MetricSpec("size", "Size", "MB", False, 1, "m:size", per_frame=False)


@pytest.fixture
def metrics():
    return [PSNR, LPIPS, SIZE]


@pytest.fixture
def make_rows():
    """Rows of a small comparison; values by method, or by a function of the row's place.

    Two subjects, of which the first has a sequence of three frames and one of a single frame.
    """
    frames = [("s1", "EMO", 0, "a"), ("s1", "EMO", 1, "a"), ("s1", "EMO", 2, "a")]
    frames += [("s1", "EXP", 3, "a"), ("s2", "EMO", 0, "a")]

    def make(values, tasks=("novel_view", "self_reenactment"), seeds=(0,), size=None, **changes):
        rows = []
        for (method, value), seed in itertools.product(values.items(), seeds):
            for task, frame, metric in itertools.product(tasks, frames, ("psnr", "lpips")):
                number = value(metric, seed, *frame) if callable(value) else value
                place = (method, "1", seed, task, *frame, "full", metric)
                rows.append(Row(*place, number, f"hash-{task}"))
            for subject in ("s1", "s2"):
                number = (size or {}).get(method, 1.0)
                rows.append(Row(method, "1", seed, "", subject, "", -1, "", "full", "size", number, ""))
        return to_frame(rows)

    return make


@pytest.fixture
def toy(monkeypatch):
    """The toy plug-in of the harness's tests, importable by name."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "bench")
    import toy_plugin

    return toy_plugin


@pytest.fixture
def toy_run(toy, tmp_path, monkeypatch):
    """The folder of a finished run: a good method, one that fails, a metric that is not available."""
    monkeypatch.setattr(runner, "write_reports", lambda folder: [])
    for subject in ("subject1", "subject2"):
        (tmp_path / "data" / subject).mkdir(parents=True)
    config = RunConfig(
        data=str(tmp_path / "data"),
        out=str(tmp_path / "out"),
        methods=("toy_plugin:METHOD", "toy_plugin:FAILING"),
        metrics=("toy_plugin:ERROR", "toy_plugin:NOT_HERE", "toy_plugin:FILES"),
        reader="toy_plugin:READER",
        preset="smoke",
    )
    runner.run(config)
    return tmp_path / "out"


@pytest.fixture
def make_run(toy, tmp_path, monkeypatch):
    """Run a toy comparison over two subjects into a folder of that name; changes are settings of the run."""
    monkeypatch.setattr(runner, "write_reports", lambda folder: [])
    for subject in ("subject1", "subject2"):
        (tmp_path / "data" / subject).mkdir(parents=True)

    def make(name, **changes):
        settings = {
            "data": str(tmp_path / "data"),
            "out": str(tmp_path / name),
            "methods": ("toy_plugin:METHOD",),
            "metrics": ("toy_plugin:ERROR", "toy_plugin:FILES"),
            "reader": "toy_plugin:READER",
            "preset": "smoke",
        }
        runner.run(RunConfig(**{**settings, **changes}))
        return tmp_path / name

    return make
