"""Settings of the suite, and its ablations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..comparison import closing
from ..condition import PLAIN, Condition, Named
from ..contracts import Progress, no_progress
from ..engine.config import RunConfig, coded_conditions, parse_size, resolve_cells, resolve_metrics
from ..engine.run import check_settings, run
from ..errors import InputError
from ..executors.settings import check_executor
from ..io.files import write_text
from ..registry import discover, get, resolve
from ..specs import CommandResult
from .suite_settings import ABLATIONS, LARGE_RUN, RUN, SEED, TRACKED, SuiteSettings

OURS = "ours"
REGIONS = ("face", "mouth", "eyes", "hair", "neck", "ears")
"""Regions of the frame with separate tables."""


def suite(settings: SuiteSettings, progress: Progress = no_progress) -> CommandResult:
    """Run the benchmark suite: ten synthetic subjects, all methods, tables by region and part.

    Ablations and tracking from images are conditions of the same run. Images of twice the size have captures and a run of their
    own, since a mean over subjects has one size. Writes ``results.md`` into ``out``.

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
    tracked = settings.tracked_of(methods)
    # A condition without methods would be one of all methods.
    conditions = [Condition(TRACKED, tracked, clip=Named(TRACKED))] if tracked else []
    config = RunConfig(
        data=str(out / "capture"),
        out=str(out / RUN),
        methods=methods,
        preset=settings.preset,
        seeds=settings.seeds,
        regions=REGIONS,
        conditions=(PLAIN, *coded_conditions(methods), *conditions, *ablations),
        isolation=settings.isolation,
    )
    cells = resolve_cells(config)
    resolve_metrics(config)
    check_executor(execution, config.device)
    check_settings(cell for cell in cells if not cell[0].is_isolated(config.isolation))
    plain = next((m.record() for m, c in cells if m.spec.name == OURS and c == PLAIN), None)
    for method, condition in cells:
        if condition.settings and method.record() == plain:
            expected = f"ablations that change {OURS} of preset {settings.preset}"
            raise InputError("command line", "--ablations", expected, condition.name)
    width, height = parse_size(settings.size)
    parts = [(config, settings.subjects, (width, height))]
    if settings.large:
        large = replace(
            config, data=str(out / "capture-large"), out=str(out / LARGE_RUN), conditions=(PLAIN,)
        )
        parts.append((large, min(settings.large, settings.subjects), (2 * width, 2 * height)))
    runs: list[Path] = []
    failed: list[str] = []
    ends = []
    for part, subjects, size in parts:
        resolve(get("datasets", "synthetic").implementation)(
            part.data,
            subjects=subjects,
            cameras=settings.cameras,
            timesteps=settings.timesteps,
            size=size,
            seed=SEED,
            performance=settings.performance,
            tracking_error=settings.tracking_error,
            tracker=settings.tracker,
            execution=execution,
            progress=progress,
        )
        rows = run(part, execution)
        runs.append(Path(part.out))
        failed += rows.failed
        ends.append(closing(runs[-1], rows))
        # After each run: the tables of the first, which took hours, do not wait for the second.
        text = resolve(get("reports", "suite").implementation)(runs, OURS)
        write_text(out / "results.md", text)
    data = {"out": out, "run": runs[0], "failed": sorted({*failed})}
    return CommandResult("\n\n".join([f"{text}\n{out / 'results.md'}", *ends]), data, not failed)
