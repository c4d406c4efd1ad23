"""Settings of the suite, and its ablations."""

from __future__ import annotations

from pathlib import Path

from ..comparison import closing
from ..condition import PLAIN, Condition
from ..contracts import Progress, no_progress
from ..engine.config import RunConfig, parse_size, resolve_cells, resolve_metrics
from ..engine.run import check_settings, run
from ..errors import InputError
from ..executors.settings import check_executor
from ..io.files import write_text
from ..registry import discover, get, resolve
from ..specs import CommandResult
from .suite_settings import ABLATIONS, SEED, SuiteSettings

OURS = "ours"
REGIONS = ("face", "mouth", "eyes", "hair", "neck", "ears")
"""Regions of the frame with separate tables."""


def suite(settings: SuiteSettings, progress: Progress = no_progress) -> CommandResult:
    """Run the benchmark suite: ten synthetic subjects, all methods, tables by region and part.

    Ablations are conditions of the same run. Writes ``results.md`` into ``out``.

    Raises
    ------
    InputError
        Methods, presets and sizes do not match; raised before the first capture is created.
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
        isolation=settings.isolation,
    )
    cells = resolve_cells(config)
    resolve_metrics(config)
    check_executor(execution, config.device)
    check_settings(cell for cell in cells if not cell[0].is_isolated(config.isolation))
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
    rows = run(config, execution)
    text = resolve(get("reports", "suite").implementation)(out / "run", OURS)
    write_text(out / "results.md", text)
    data = {"out": out, "run": out / "run", "failed": rows.failed}
    return CommandResult(
        f"{text}\n{out / 'results.md'}\n\n{closing(out / 'run', rows)}", data, not rows.failed
    )
