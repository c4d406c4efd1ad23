"""The suite: its conditions, and a run for each subject."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

from ..comparison import closing
from ..condition import PLAIN, Condition, Named
from ..contracts import Progress, no_progress
from ..engine.config import (
    RunConfig,
    coded_conditions,
    parse_size,
    resolve_cells,
    resolve_methods,
    resolve_metrics,
)
from ..engine.plan import check_settings
from ..engine.run import run
from ..errors import InputError
from ..executors.settings import check_executor
from ..io.files import write_text
from ..registry import discover, get, resolve
from ..specs import CommandResult, MethodSpec, command
from .robustness import ExtremesSettings, extremes_run
from .suite_settings import (
    ALL,
    AS_TRACKED,
    EQUAL,
    EQUAL_TO,
    LARGE_RUN,
    LEVEL,
    NONE,
    RUN,
    SEED,
    SEEDS_RUN,
    TRACKED,
    SuiteSettings,
)

OURS = "ours"
REGIONS = ("face", "mouth", "eyes", "hair", "neck", "ears")
"""Regions of the frame with separate tables."""


@command("run suite", group="compare", writes="out")
def suite(settings: SuiteSettings, progress: Progress = no_progress) -> CommandResult:
    """Run the benchmark suite: ten synthetic subjects, all methods; takes hours.

    Every subject has its own run, with conditions. Subjects run one after another, and the tables of ``results.md`` are written
    after each. Images of twice the size have separate captures and runs, since means over subjects need equal sizes.

    Raises
    ------
    InputError
        Methods, presets and sizes do not match; raised before the first capture is created.
    """
    out, execution = Path(settings.out), settings.execution
    methods = settings.methods or tuple(
        name for name, plugin in discover("methods").items() if plugin.spec and plugin.spec.demo
    )
    plain = RunConfig(
        data=str(out / "capture"),
        out=str(out / RUN),
        methods=methods,
        preset=settings.preset,
        seeds=settings.seeds,
        regions=REGIONS,
    )
    coded = (PLAIN, *coded_conditions(methods))
    config = replace(plain, conditions=(*coded, *_conditions(settings, plain)))
    cells = resolve_cells(config)
    resolve_metrics(config)
    check_executor(execution, config.device)
    check_settings(cells)
    width, height = parse_size(settings.size)
    large = replace(plain, data=str(out / "capture-large"), out=str(out / LARGE_RUN), conditions=coded)
    seeds = tuple(max(settings.seeds) + further for further in (1, 2))
    more_seeds = replace(plain, out=str(out / SEEDS_RUN), seeds=seeds, conditions=(PLAIN,))
    failed: list[str] = []
    ends: list[str] = []
    runs: list[Path] = []
    for place in range(settings.first - 1, settings.subjects):
        parts = [(config, (width, height))]
        if place < settings.repeated:
            parts.append((more_seeds, (width, height)))
        if place < settings.large:
            parts.append((large, (2 * width, 2 * height)))
        for part, size in parts:
            (capture,) = resolve(get("datasets", "synthetic").implementation)(
                part.data,
                subjects=settings.subjects,
                only=place,
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
            own = replace(part, data=str(capture), out=str(Path(part.out) / f"{place + 1:02d}"))
            rows = run(own, execution).rows
            runs.append(Path(own.out))
            failed += rows.failed
            trained = any(not method.spec.trivial for method, _ in cells)
            if part is config and trained and place < settings.extremes:
                how = {name: getattr(settings, name) for name in ("executor", "workers", "set")}
                extremes_run(ExtremesSettings(own.out, **how), progress)
            ends.append(closing(runs[-1], rows))
            text = resolve(get("reports", "suite").implementation)(out, OURS)
            write_text(out / "results.md", text)
    data = {"out": out, "runs": runs, "failed": sorted({*failed})}
    return CommandResult(
        "\n\n".join([f"Tables of all results: {out / 'results.md'}", *ends]), data, not failed
    )


def _conditions(settings: SuiteSettings, config: RunConfig) -> list[Condition]:
    """All conditions except the plain comparison. Those without methods are omitted, since they would apply to all methods."""
    resolved = resolve_methods(config)
    specs = {method.spec.name: method.spec for method in resolved}
    tracked = settings.tracked_of(tuple(specs))
    own = tuple(name for name, spec in specs.items() if spec.conversion == "published")
    found = [Condition(AS_TRACKED, own, as_tracked=True), Condition(TRACKED, tracked, clip=Named(TRACKED))]
    found += [
        Condition(LEVEL.format(level), tracked, clip=Named("tracking-error", {"level": level}))
        for level in settings.levels
    ]
    iterations = {
        method.spec.name: method.budget.iterations for method in resolved if not method.spec.trivial
    }
    if (count := iterations.get(EQUAL_TO)) is not None:
        others = (OURS,) if iterations.get(OURS) not in (None, count) else ()
        asked = settings.equal_iterations or others
        names = tuple(name for name in asked if name != NONE)
        found.append(Condition(EQUAL, names, {"budget": {"iterations": count}}))
    found = [condition for condition in found if condition.methods]
    estimated = [condition for condition in found if condition.clip and OURS in condition.methods]
    ours = {name: spec for name, spec in specs.items() if name == OURS}
    crossed = _ablations("--tracked-ablations", settings.tracked_ablations, ours)
    if crossed and not estimated:
        expected = f"{OURS} among those of --tracked, which --tracked-ablations are compared with"
        raise InputError("command line", "--tracked", expected, " ".join(tracked) or NONE)
    return [
        *found,
        *_ablations("--ablations", settings.ablations, specs),
        *(
            replace(ablation, name=f"{ablation.name}-{condition.name}", clip=condition.clip)
            for ablation, condition in product(crossed, estimated)
        ),
    ]


def _ablations(option: str, asked: Sequence[str], specs: dict[str, MethodSpec]) -> list[Condition]:
    """The requested ablations in the order of the methods' specs; the one of ours if several methods have the name.

    Raises `InputError` for unknown ones, and for `ALL` without ours.
    """
    if ALL in asked and OURS not in specs:
        expected = f"{OURS} among them, whose {option} are all"
        raise InputError("command line", "--methods", expected, ", ".join(specs))
    known: dict[str, Condition] = {}
    for spec in sorted(specs.values(), key=lambda spec: spec.name == OURS):
        known |= {name: Condition(name, (spec.name,), dict(own)) for name, own in spec.ablations.items()}
    for name in asked:
        if name not in (*known, ALL):
            raise InputError("command line", option, f"{', '.join(known)} or {ALL}", name)
    return [
        each for name, each in known.items() if name in asked or (ALL in asked and each.methods == (OURS,))
    ]
