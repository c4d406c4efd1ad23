"""``headbench suite``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..condition import PLAIN, Condition
from ..contracts import Progress, no_progress
from ..errors import InputError
from ..executors.command import ExecutionOptions
from ..executors.settings import check_executor
from ..io.files import write_text
from ..registry import discover, get, resolve
from ..runner.config import RunConfig, parse_size, resolve_cells, resolve_metrics
from ..runner.run import check_settings, run
from ..specs import Findings, writes

SEED = 26_000
"""Of the suite's captures. Settings of methods are chosen on captures of seeds below 10,000 (`README.md`)."""

ABLATIONS: Mapping[str, Mapping[str, Any]] = {
    "no-lines": {"lines": {"enabled": False}},
    "lines-move-splats": {"lines": {"dynamic": ["position", "rotation", "scale"]}},
    "lines-color": {"lines": {"dynamic": ["color"]}},
    "no-penalty": {"penalty": {"weight": 0.0}},
    "no-balanced-sampling": {"sampling": {"balanced": False}},
    "fixed-sizes": {"capacity": {"mode": "fixed"}},
    "harmonics": {"color": "sh"},
    "lines-in-head": {"lines": {"bounds": "head"}},
    "no-direction-smoothing": {"planes": {"direction_smoothing": 0.0}},
    "published": {
        "capacity": {"mode": "fixed"},
        "lines": {"bounds": "head"},
        "planes": {"direction_smoothing": 0.0, "residual_lr": 0.0, "move_splats": True},
    },
}
"""Settings of ours by the name of what is left out or changed; the first two are the paper's Table 4."""

ALL = "all"


@dataclass(frozen=True)
class SuiteSettings(ExecutionOptions):
    """The whole benchmark: makes the suite's synthetic subjects, trains and measures methods on all, writes result tables.

    Subjects differ in shape, skin, hair and performance; their tracking has errors, and their held-out sequence three parts:
    seen, recombined and beyond training. Started again after a kill it continues. Takes hours.
    """

    out: str
    """Folder for captures, runs and results.md."""

    methods: tuple[str, ...] = ()
    """Methods; default: those of `headbench demo`."""

    preset: str = "fast"
    """How much training, as for `headbench run`."""

    seeds: tuple[int, ...] = (0,)
    """Seeds of the training."""

    ablations: tuple[str, ...] = ()
    """Train ours with these parts left out or changed, too, each as a condition of the run; or "all"."""

    subjects: int = 10
    """How many of the suite's subjects, from the first. To be told apart two methods take 6 of them, five methods 8, ten
    ablations 9."""

    cameras: int = 8
    """Views of each, the held-out one included."""

    timesteps: int = 160
    """Of each subject; a quarter is held out."""

    size: str = "144x208"
    """Width x height of the images in pixels."""

    tracking_error: float = 1.0
    """As for `headbench synth`."""

    def __post_init__(self) -> None:
        """Refuse sizes and names that are none."""
        parse_size(self.size)
        unknown = [name for name in self.ablations if name not in (*ABLATIONS, ALL)]
        if unknown:
            raise InputError("command line", "--ablations", f"{', '.join(ABLATIONS)} or {ALL}", unknown[0])

    @property
    def chosen(self) -> tuple[str, ...]:
        """Names of the ablations asked for, in the order of `ABLATIONS`."""
        return tuple(name for name in ABLATIONS if name in self.ablations or ALL in self.ablations)


OURS = "ours"
REGIONS = ("face", "mouth", "eyes", "hair", "neck", "ears")
"""Parts of the frame that have tables of their own."""


@writes("out")
def suite(settings: SuiteSettings, progress: Progress = no_progress) -> Findings:
    """Run the benchmark suite: ten synthetic subjects, all methods, tables by region and part.

    Ablations are conditions of the same run. Writes ``results.md`` into ``out``.

    Raises
    ------
    InputError
        For methods, presets and sizes that do not fit, before the first capture is made.
    """
    out, execution = Path(settings.out), settings.execution
    methods = settings.methods or tuple(
        name for name, plugin in discover("methods").items() if plugin.spec and plugin.spec.demo
    )
    if settings.ablations and OURS not in methods:
        expected = f"{OURS} among them, which --ablations are compared with"
        raise InputError("command line", "--methods", expected, ", ".join(methods))
    ablations = [Condition(name, (OURS,), dict(ABLATIONS[name])) for name in settings.chosen]
    config = RunConfig(
        data=str(out / "capture"),
        out=str(out / "run"),
        methods=methods,
        preset=settings.preset,
        seeds=settings.seeds,
        regions=REGIONS,
        conditions=(PLAIN, *ablations),
    )
    cells = resolve_cells(config)
    resolve_metrics(config)
    check_executor(execution, config.device)
    check_settings(cells)
    plain = next((m.record() for m, c in cells if m.spec.name == OURS and c == PLAIN), None)
    for method, condition in cells:
        if condition.name and method.record() == plain:
            expected = f"ablations that change {OURS} of preset {settings.preset}"
            raise InputError("command line", "--ablations", expected, condition.name)
    resolve(get("datasets", "synthetic").implementation)(
        out / "capture",
        subjects=settings.subjects,
        cameras=settings.cameras,
        timesteps=settings.timesteps,
        size=parse_size(settings.size),
        seed=SEED,
        performance="parts",
        tracking_error=settings.tracking_error,
        execution=execution,
        progress=progress,
    )
    failed = run(config, execution).failed
    text = resolve(get("reports", "suite").implementation)(out / "run", OURS)
    write_text(out / "results.md", text)
    data = {"out": out, "run": out / "run", "failed": failed}
    return Findings(f"{text}\n{out / 'results.md'}", data, not failed)
