"""Runs the suite and writes its results as tables."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.executors.settings import check_executor
from ...bench.io.files import write_text
from ...bench.registry import discover, get, resolve
from ...bench.runner.config import (
    ResolvedMethod,
    RunConfig,
    parse_size,
    resolve_methods,
    resolve_metrics,
)
from ...bench.runner.run import check_settings, run
from ...bench.runner.scoring import FULL
from ...bench.runner.store import RunFolder
from ...bench.specs import Findings
from ..runs import Part, RunSet
from ..statistics.command import CompareSettings, compare_methods
from ..table_report import table_of
from ..writers import to_markdown
from .ablations import ablation_table
from .settings import ABLATIONS, SEED, SuiteSettings

OURS = "ours"
REGIONS = ("face", "mouth", "eyes", "hair", "neck", "ears")
"""Parts of the frame that have tables of their own."""


def run_suite(settings: SuiteSettings, progress: Progress = no_progress) -> Findings:
    """Make the captures, run the comparison and, if asked for, the ablations; write ``results.md`` into ``out``.

    Raises `InputError` for methods, presets and sizes that do not fit, before the first capture is made.
    """
    out, execution = Path(settings.out), settings.execution
    methods = settings.methods or tuple(
        name for name, plugin in discover("methods").items() if plugin.spec and plugin.spec.demo
    )
    if settings.ablations and OURS not in methods:
        expected = f"{OURS} among them, which --ablations are compared with"
        raise InputError("command line", "--methods", expected, ", ".join(methods))
    runs = {"run": _config(settings, out, "run", methods, {})}
    for name in settings.chosen:
        changes = {OURS: dict(ABLATIONS[name])}
        runs[f"ablation-{name}"] = _config(settings, out, f"ablation-{name}", (OURS,), changes)
    for name, config in runs.items():
        resolved = resolve_methods(config)
        resolve_metrics(config)
        check_executor(execution, config.device)
        folder = RunFolder(Path(config.out))
        if not (folder.manifest.exists() and folder.read_manifest().status == "done"):
            for method in resolved:
                check_settings(method)
        if name != "run" and resolved[0].record() == _ours(runs["run"]).record():
            expected = f"ablations that change {OURS} of preset {settings.preset}"
            raise InputError("command line", "--ablations", expected, name.removeprefix("ablation-"))
    make = resolve(get("datasets", "synthetic").implementation)
    make(
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
    failed = {name: run(config, execution).failed for name, config in runs.items()}
    text = results(out / "run", [out / name for name in runs])
    write_text(out / "results.md", text)
    data = {"out": out, "runs": [out / name for name in runs], "failed": failed}
    return Findings(f"{text}\n{out / 'results.md'}", data, not any(failed.values()))


def _ours(config: RunConfig) -> ResolvedMethod:
    return next(method for method in resolve_methods(config) if method.spec.name == OURS)


def _config(
    settings: SuiteSettings, out: Path, name: str, methods: tuple[str, ...], changes: dict[str, Any]
) -> RunConfig:
    return RunConfig(
        data=str(out / "capture"),
        out=str(out / name),
        methods=methods,
        preset=settings.preset,
        seeds=settings.seeds,
        regions=REGIONS,
        settings=changes,
    )


def results(run_folder: Path, every: list[Path]) -> str:
    """Tables of a suite as Markdown: whole frames, each region, each held-out sequence, and the ablations of ours.

    Under each table are the paired differences of every method from ours, with intervals and tests. Those of the ablations
    are such differences, of whole frames and of the face, in all sequences and in each held-out one.
    """
    runs = RunSet.read([run_folder])
    tested = sorted({frame[1] for frame in runs.rows.frames("self_reenactment", FULL)})
    parts = {"All frames": Part()}
    parts |= {f"Region {region}": Part(region) for region in sorted(runs.rows.regions - {FULL})}
    parts |= {f"Sequence {name}": Part(sequences=(name,)) for name in tested}
    sections = [_section(title, runs.of(part)) for title, part in parts.items()]
    if len(every) > 1:
        runs = RunSet.read(every)
        for region, chosen in product((FULL, "face"), ((), *((name,) for name in tested))):
            title = ", ".join(["Ablations of ours", *([] if region == FULL else [region]), *chosen])
            table = ablation_table(runs.of(Part(region, chosen)), OURS)
            sections.append(f"## {title}\n\n{to_markdown(table).strip()}")
    return "\n\n".join(sections) + "\n"


def _section(title: str, runs: RunSet) -> str:
    """A table and, where ours is among several methods, their differences from it."""
    text = f"## {title}\n\n{to_markdown(table_of(runs)).strip()}"
    if OURS not in runs.ranked or len(runs.ranked) < 2:
        return text
    folders = tuple(str(run.folder.root) for run in runs.runs)
    compared = compare_methods(runs, CompareSettings(folders, against=OURS))
    return f"{text}\n\n```text\n{compared.text}\n```"
