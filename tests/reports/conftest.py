import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from headbench.bench.engine.config import RunConfig
from headbench.bench.engine.store import RunFolder
from headbench.bench.manifest import Manifest, MethodRecord, ProtocolRecord
from headbench.bench.rows import Rows
from headbench.bench.specs import MetricSpec
from headbench.reports.pareto import command as pareto

from ..world import run_on
from .made_rows import TASKS, avatar_row, row

PSNR = MetricSpec("psnr", "PSNR", "dB", True, 2, "m:psnr")
LPIPS = MetricSpec("lpips", "LPIPS", "", False, 3, "m:lpips")
SIZE = MetricSpec("size", "Size", "MB", False, 1, "m:size", kind="avatar")


@pytest.fixture
def metrics():
    return [PSNR, LPIPS, SIZE]


@pytest.fixture
def change_manifest():
    """Change ``run.json`` of a folder by a function of its content."""

    def change(folder, how):
        path = RunFolder(folder).manifest
        manifest = json.loads(path.read_text())
        how(manifest)
        path.write_text(json.dumps(manifest))

    return change


@pytest.fixture
def make_rows():
    """Table of the rows of a small comparison; values by method, or by a function of the row's place.

    Two subjects, of which the first has a sequence of three frames and one of a single frame.
    """
    frames = [("s1", "EMO", 0, "a"), ("s1", "EMO", 1, "a"), ("s1", "EMO", 2, "a")]
    frames += [("s1", "EXP", 3, "a"), ("s2", "EMO", 0, "a")]

    def make(values, tasks=TASKS, seeds=(0,), size=None):
        rows = []
        for (method, value), seed in itertools.product(values.items(), seeds):
            for task, frame, metric in itertools.product(tasks, frames, ("psnr", "lpips")):
                number = value(metric, seed, *frame) if callable(value) else value
                rows.append(
                    row(method, metric, number, *frame, seed=seed, task=task, protocol=f"hash-{task}")
                )
            number = (size or {}).get(method, 1.0)
            rows += [avatar_row(method, "size", number, subject, seed=seed) for subject in ("s1", "s2")]
        return pd.DataFrame(rows)

    return make


@pytest.fixture
def write_manifest():
    """Write ``run.json`` of a finished run; ``methods`` are their configurations by name, protocols hashes by task."""

    def write(folder, metrics, methods, protocols, seeds=(0,), trivial=()):
        Manifest(
            configuration=RunConfig(data="data", out=str(folder.root), seeds=tuple(seeds)),
            methods=tuple(
                MethodRecord(
                    name.partition("+")[0],
                    "1",
                    "m:M",
                    name.partition("+")[0] in trivial,
                    config,
                    {},
                    condition=name.partition("+")[2],
                )
                for name, config in methods.items()
            ),
            metrics=tuple(metrics),
            clips=(),
            protocols={
                task: ProtocolRecord(f"{task}/1", name, task, (), (), (), "", (1.0, 1.0, 1.0), "", "")
                for task, name in protocols.items()
            },
            machine={"processor": "abacus"},
            status="done",
        ).write(folder.manifest)

    return write


@pytest.fixture
def toy(monkeypatch):
    """The toy plug-in of the harness's tests, importable by name."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "bench")
    import toy_plugin

    return toy_plugin


@pytest.fixture
def toy_run(make_run):
    """The folder of a finished run: a good method, one that fails, a metric that is not available."""
    metrics = ("toy_plugin:ERROR", "toy_plugin:NOT_HERE", "toy_plugin:FILES")
    return make_run("out", methods=("toy_plugin:METHOD", "toy_plugin:FAILING"), metrics=metrics)


@pytest.fixture(scope="session")
def made_runs(tmp_path_factory):
    """Folder of each toy run of this session, with its captures, by settings."""
    return tmp_path_factory.mktemp("made"), {}


@pytest.fixture
def make_run(toy, tmp_path, made_runs):
    """Copy a toy comparison over two subjects into a folder of that name; changes are settings of the run."""
    place, made = made_runs

    def make(name, methods=("toy_plugin:METHOD",), subjects=("subject1", "subject2"), **changes):
        settings = {"metrics": ("toy_plugin:ERROR", "toy_plugin:FILES"), "reader": "toy_plugin:READER"}
        key, data = repr((methods, subjects, changes)), "data" if len(subjects) > 1 else f"data-{subjects[0]}"
        if key not in made:
            made[key] = place / str(len(made)) / "run"
            run_on(made[key].with_name(data), made[key], *methods, subjects=subjects, **settings | changes)
        shutil.copytree(made[key].with_name(data), tmp_path / data, dirs_exist_ok=True)
        run = RunFolder(Path(shutil.copytree(made[key], tmp_path / name)))
        text = run.manifest.read_text().replace(str(made[key]), str(run.root))
        run.manifest.write_text(text.replace(str(made[key].parent), str(tmp_path)))
        return run.root

    return make


@pytest.fixture
def write_run(tmp_path, write_manifest):
    """Write a finished run of four subjects by hand: each method at its PSNR; settings by method."""
    # Offset and slope of each metric over the PSNR.
    lines = {"psnr": (0, 1), "ssim": (0, 0.025), "lpips": (0.1, -0.001), "storage": (5, 0.1), "fps": (100, 1)}

    def write(name, methods, settings=None):
        folder = RunFolder(tmp_path / name)
        of_avatar = ("storage", "fps")
        specs = [
            MetricSpec(
                *(m, m.upper(), "", m not in ("lpips", "storage"), 4, "m:m"),
                kind="avatar" if m in of_avatar else "frame",
                machine_bound=m == "fps",
                tables=("comparison", *{"storage": ("cost",), "fps": ("speed",)}.get(m, ())),
            )
            for m in lines
        ]
        settings = {method: (settings or {}).get(method) for method in methods}
        protocols = {task: f"hash-{task}" for task in TASKS}
        write_manifest(folder, specs, settings, protocols, trivial=("mean-image",))
        rows = []
        for (method, level), subject, spec in itertools.product(methods.items(), "abcd", specs):
            offset, slope = lines[spec.name]
            number = offset + slope * level
            if spec.per_frame:
                places = [{"task": task, "protocol": f"hash-{task}"} for task in TASKS]
                rows += [row(method, spec.name, number, subject, **place) for place in places]
            else:
                rows.append(avatar_row(method, spec.name, number, subject))
        labels = (each.method.partition("+") for each in rows)
        Rows.of(
            replace(each, method=name, condition=condition)
            for each, (name, _, condition) in zip(rows, labels, strict=True)
        ).write(folder.rows)
        return folder.root

    return write


@pytest.fixture
def no_plots(monkeypatch):
    """Leave out the drawing of `report pareto`, which takes longer than all else it does."""
    monkeypatch.setattr(pareto, "write_plot", lambda *args, **options: None)
