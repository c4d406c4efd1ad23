"""Trains the methods of a run with parts of their budgets and measures them on held-out training frames."""

from __future__ import annotations

import logging
import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

from ...bench.contracts import Budget, Clip
from ...bench.errors import InputError
from ...bench.io.files import check_name, write_text
from ...bench.machine import check_device
from ...bench.manifest import MethodRecord
from ...bench.protocol import Protocol, make_protocols
from ...bench.rows import ALL, Rows
from ...bench.runner.captures import open_run_clips, run_configuration
from ...bench.runner.config import ResolvedMethod, RunConfig, resolve_methods, resolve_metrics
from ...bench.runner.run import describe, make_jobs, run_jobs, warn_of_missing_metrics
from ...bench.runner.scoring import FULL
from ...bench.runner.steps import Job
from ...bench.runner.store import RunFolder
from ...bench.specs import Findings, MetricSpec
from ..aggregate import subject_means
from ..writers import csv_text
from .command import CurveSettings
from .held_out import CAMERA, TIMESTEPS, HeldOutClip, hold_out, reduced
from .plot import Panel, write_plot

log = logging.getLogger(__name__)
METRICS: tuple[str, ...] = ("psnr", "ssim", "lpips", "storage", "primitives")
"""Metrics of a curve, whether the run took them or not, as the canonical profile defines them."""
HELD_OUT = {CAMERA: "camera", TIMESTEPS: "timesteps"}
"""What is held out, by the task that it is measured as."""
MEASURED = ("processor_seconds", "seconds", "peak_memory_bytes")
"""What the record of a training says of its cost."""
MARK = "+"
"""Between the name of a method and the part of its budget."""


@dataclass(frozen=True)
class Point:
    """A method trained with a part of its budget or of the frames: means over seeds of one subject, or over subjects ("").

    ``cameras`` and ``timesteps`` count what it was trained on. ``cost`` is `MEASURED` by name, ``values`` are the metrics
    by name and what was held out, such as "psnr_camera". None: not measured.
    """

    method: str
    subject: str
    part: Fraction
    budget: Budget
    cameras: float
    timesteps: float
    cost: Mapping[str, float | None]
    values: Mapping[str, float | None]


def curve(settings: CurveSettings, out: Path) -> Findings:
    """Train, measure, write ``curve.csv`` and ``curve.png`` into ``out``, whose lock is held; return points and a table.

    Started again, it keeps trainings that ended. One that was interrupted begins again, since its time is asked for.

    Raises
    ------
    InputError
        For a method that the run does not have or that has no budget, a capture that is not the run's or has too few
        frames to hold some out, and a folder with trainings of other settings.
    """
    run = RunFolder(Path(settings.run))
    wanted = _wanted(settings, run)
    config, clips = open_run_clips(run.root, settings, out=out)
    check_device(config.device)
    held = [hold_out(clip, settings.camera, settings.every) for clip in clips]
    tasks = tuple(task for task in HELD_OUT if all(task in clip.splits for clip in held))
    config = replace(
        config,
        tasks=tasks,
        frames_per_task=settings.frames,
        metrics=METRICS,
        metric_profiles=("canonical",),
        regions=(),
    )
    metrics = resolve_metrics(config)
    subjects: list[Clip] = [*held]
    protocols = make_protocols(tasks, subjects, settings.frames)
    folder = RunFolder(out)
    trainings = _trainings(config, settings, wanted, held, protocols, run, folder)
    jobs = [job for training in trainings for job in training.jobs]
    for job in jobs:
        job.check()
    warn_of_missing_metrics(metrics, held[0])
    manifest = replace(
        describe(config, [], metrics, subjects, protocols),
        methods=tuple({job.method.spec.name: MethodRecord(**job.method.record()) for job in jobs}.values()),
        curve_of=settings.run,
    )
    manifest.write(folder.manifest)
    for job in jobs:
        _drop_interrupted(job)
    rows = run_jobs(jobs, metrics)
    rows.write(folder.rows)
    replace(manifest, status="done").write(folder.manifest)

    names, order = [m.spec.name for m in wanted], [clip.subject for clip in clips]
    trainings.sort(key=lambda t: (names.index(t.method.spec.name), t.part, order.index(t.clip.subject)))
    points = [_point(training, rows, metrics, tasks) for training in trainings]
    groups: dict[tuple[str, Fraction], list[Point]] = {}
    for point in points:
        groups.setdefault((point.method, point.part), []).append(point)
    means = [_mean(group) for group in groups.values()]
    missing = {spec.label: _reason(rows, spec) for spec in metrics if spec.per_frame and _reason(rows, spec)}
    write_text(out / "curve.csv", csv_text(_lines(points)))
    clock = "processor_seconds" if config.device == "cpu" else "seconds"
    where = f"{settings.every}th training timestep" if settings.every > 2 else "second training timestep"
    axis = f"{'Processor seconds' if clock == MEASURED[0] else 'Seconds'} of training"
    axis = axis if settings.over == "budget" else f"Training {settings.over}"
    write_plot(
        out / "curve.png",
        [
            [
                _panel(means, spec, task, settings.over, clock, missing.get(spec.label, ""))
                for spec in metrics
                if spec.per_frame
            ]
            for task in tasks
        ],
        axis,
        f"Held out of every training: a training camera, every {where}. No test frame was looked at.",
    )
    data = {
        "out": out,
        "held_out": {clip.subject: clip.steps[-1].parameters for clip in held},
        "points": [_flat(point) for point in points],
        "missing": missing,
        "failed": rows.failed,
    }
    return Findings(_text(means, metrics, tasks, held, missing, rows.failed), data, not rows.failed)


def _wanted(settings: CurveSettings, run: RunFolder) -> list[ResolvedMethod]:
    """The methods to train, each with a budget."""
    trained = {record.name for record in run.read_manifest().methods}
    resolved = [m for m in resolve_methods(run_configuration(run.root, settings)) if m.spec.name in trained]
    names = ", ".join(method.spec.name for method in resolved) or "none that it trained"
    for name in settings.methods:
        if name not in [method.spec.name for method in resolved]:
            raise InputError(run.manifest, "methods", f"methods of the run: {names}", name)
    wanted = [
        m for m in resolved if (m.spec.name in settings.methods if settings.methods else not m.spec.trivial)
    ]
    if not wanted:
        raise InputError(run.manifest, "methods", "a method that is no trivial baseline", names)
    for method in wanted:
        if method.budget == Budget():
            expected = "iterations or seconds, to train with a part of"
            raise InputError(
                run.manifest,
                f"budget of {method.spec.name}",
                expected,
                "none",
                "Name other methods with --methods.",
            )
        method.create()
    return wanted


def _budgets(whole: Budget, parts: Iterable[Fraction]) -> dict[Budget, Fraction]:
    """Parts of a budget by what they come to, an iteration at least; the largest of those that come to the same."""
    return {
        Budget(
            None if whole.iterations is None else max(1, round(whole.iterations * part)),
            None if whole.seconds is None else whole.seconds * float(part),
        ): part
        for part in parts
    }


def _name(method: str, part: Fraction) -> str:
    return f"{method}{MARK}{str(part).replace('/', '-')}"


@dataclass(frozen=True)
class _Training:
    """A method with its whole budget, the part of it or of the frames that it is given, ``clip``: a job for each seed."""

    method: ResolvedMethod
    part: Fraction
    clip: HeldOutClip
    jobs: tuple[Job, ...]


def _trainings(
    config: RunConfig,
    settings: CurveSettings,
    wanted: Sequence[ResolvedMethod],
    held: Sequence[HeldOutClip],
    protocols: Mapping[str, Protocol],
    run: RunFolder,
    folder: RunFolder,
) -> list[_Training]:
    """Every training; the whole first: start-up, such as imports, falls where it weighs least."""
    over, found = settings.over, []
    given: dict[tuple[str, ...], tuple[Fraction, list[HeldOutClip]]] = {}
    for part in reversed(settings.parts):
        clips = [clip if over == "budget" else reduced(clip, over, part) for clip in held]
        given.setdefault(tuple(clip.fingerprint for clip in clips), (part, clips))
    for part, clips in given.values():
        bases = make_jobs(config, wanted, clips, protocols, run, folder.root)
        for method, (clip, whole) in product(wanted, zip(clips, held)):
            parts = {method.budget: part} if over != "budget" else _budgets(method.budget, settings.parts)
            own = [job for job in bases if (job.clip, job.method.spec.name) == (clip, method.spec.name)]
            for budget, share in reversed(parts.items()):
                # The frames to measure are those of all trainings, whatever each is given.
                jobs = [job if clip is whole else replace(job, clip=whole, adapted=job.form) for job in own]
                found.append(
                    _Training(method, share, clip, tuple(_job(job, share, budget, folder) for job in jobs))
                )
    return found


def _job(base: Job, part: Fraction, budget: Budget, folder: RunFolder) -> Job:
    """The cell of a training with a part of the budget."""
    spec = base.method.spec
    name = check_name(_name(spec.name, part), "registry of methods", "name")
    return replace(
        base,
        method=replace(base.method, spec=replace(spec, name=name), budget=budget),
        cell=folder.cell(base.clip.subject, name, base.seed),
    )


def _drop_interrupted(job: Job) -> None:
    """Remove what a killed training left, so that it begins again and its time is known."""
    state = job.cell.step("fit")
    if state is not None and state["status"] != "done":
        if job.cell.avatar.exists():
            log.info("%s: its training was interrupted; it begins again", job.name)
            shutil.rmtree(job.cell.avatar)
        (job.cell.folder / "fit.json").unlink()


def _point(training: _Training, rows: Rows, metrics: Sequence[MetricSpec], tasks: Sequence[str]) -> Point:
    job = training.jobs[0]
    name, subject = job.method.spec.name, job.clip.subject
    records: list[Mapping[str, Any]] = [job.cell.step("fit") or {} for job in training.jobs]
    cost = {key: mean([_number(record.get(key)) for record in records]) for key in MEASURED}
    values: dict[str, float | None] = {}
    for spec in metrics:
        for task in tasks if spec.per_frame else ("",):
            chosen = rows.select(
                method=name, metric=spec.name, task=task, region=FULL, seeds=ALL, subject=subject
            )
            whole = len(chosen) and (chosen["status"] == "ok").all()
            values[_column(spec, task)] = subject_means(chosen)[subject] if whole else None
    keys = training.clip.splits["train"]
    cameras, timesteps = (len({getattr(key, name) for key in keys}) for name in ("camera", "timestep"))
    method = training.method.spec.name
    return Point(method, subject, training.part, job.method.budget, cameras, timesteps, cost, values)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, (int, float)) else None


def _column(spec: MetricSpec, task: str) -> str:
    return f"{spec.name}_{HELD_OUT[task]}" if task in HELD_OUT else spec.name  # type: ignore[index]


def mean(values: Sequence[float | None]) -> float | None:
    """Mean of numbers; None where one is missing, or all."""
    known = [value for value in values if value is not None]
    return fmean(known) if known and len(known) == len(values) else None


def _mean(points: Sequence[Point]) -> Point:
    """The mean over subjects."""
    first = points[0]
    cost = {key: mean([point.cost[key] for point in points]) for key in first.cost}
    values = {key: mean([point.values[key] for point in points]) for key in first.values}
    cameras, timesteps = (
        fmean(getattr(point, name) for point in points) for name in ("cameras", "timesteps")
    )
    return replace(first, subject="", cameras=cameras, timesteps=timesteps, cost=cost, values=values)


def _reason(rows: Rows, spec: MetricSpec) -> str:
    """Why a metric was not measured; "" where it was, or where trainings failed."""
    own = rows.select(method=ALL, metric=spec.name, task=ALL, region=FULL, seeds=ALL)
    reasons = own.loc[own["status"] == "missing", "reason"]
    return " ".join(str(reasons.iloc[0]).split()) if len(reasons) else ""


def _flat(point: Point) -> dict[str, object]:
    budget = asdict(point.budget)
    return {
        "method": point.method,
        "subject": point.subject,
        "fraction": float(point.part),
        "budget_iterations": budget["iterations"],
        "budget_seconds": budget["seconds"],
        "cameras": point.cameras,
        "timesteps": point.timesteps,
        **point.cost,
        **point.values,
    }


def _lines(points: Sequence[Point]) -> list[list[object]]:
    flat = [_flat(point) for point in points]
    return [[*flat[0]], *([*line.values()] for line in flat)]


def _panel(
    points: Sequence[Point], spec: MetricSpec, task: str, over: str, clock: str, missing: str
) -> Panel:
    lines: dict[str, list[tuple[float, float]]] = {}
    for point in points:
        cost = point.cost[clock] if over == "budget" else getattr(point, over)
        value = point.values[_column(spec, task)]
        line = lines.setdefault(point.method, [])
        if cost is not None and value is not None:
            line.append((max(cost, 1e-3), value))  # recorded to a millisecond
    unit = f", {spec.unit}" if spec.unit else ""
    return Panel(f"{spec.label}{unit}, held-out {HELD_OUT[task]}", lines, missing)  # type: ignore[index]


def _text(
    points: Sequence[Point],
    metrics: Sequence[MetricSpec],
    tasks: Sequence[str],
    held: Sequence[HeldOutClip],
    missing: Mapping[str, str],
    failed: Sequence[str],
) -> str:
    wide = max(8, *(len(point.method) + 2 for point in points))
    frame = [spec for spec in metrics if spec.per_frame]
    avatar = [spec for spec in metrics if not spec.per_frame]
    group = 9 * len(frame)
    head = "".join(f"{'held-out ' + HELD_OUT[task]:>{group}}" for task in tasks)  # type: ignore[index]
    names = "".join(f"{spec.label:>9}" for _ in tasks for spec in frame)
    names += "".join(f"{spec.label + (f' {spec.unit}' if spec.unit else ''):>12}" for spec in avatar)
    lines = [
        f"{'':<{wide + 56}}{head}",
        f"{'method':<{wide}}{'part':>7}{'budget':>10}{'cameras':>8}{'timesteps':>11}{'CPU s':>10}{'s':>10}{names}",
    ]
    for point in points:
        budget = point.budget
        cells = [
            _shown(point.values[_column(spec, task)], spec.digits, 9) for task in tasks for spec in frame
        ]
        cells += [_shown(point.values[spec.name], spec.digits, 12) for spec in avatar]
        cost = [_shown(point.cost[key], 1, 10) for key in MEASURED[:2]]
        size = f"{budget.seconds:g} s" if budget.iterations is None else f"{budget.iterations}"
        given = f"{point.part!s:>7}{size:>10}{point.cameras:>8g}{point.timesteps:>11g}"
        lines.append(f"{point.method:<{wide}}{given}{''.join([*cost, *cells])}")
    lines.append("Means over subjects. Held out of every training; no test frame was looked at:")
    for clip in held:
        parameters = clip.steps[-1].parameters
        steps = ", ".join(map(str, parameters["timesteps"][:6])) + (
            ", ..." if len(parameters["timesteps"]) > 6 else ""
        )
        lines.append(
            f"  {clip.subject}: camera {parameters['camera'] or 'none'}, timesteps {steps or 'none'}"
        )
    lines += [f"{label} missing: {reason}" for label, reason in missing.items()]
    return "\n".join([*lines, *(f"failed: {name}" for name in failed)])


def _shown(value: float | None, digits: int, width: int) -> str:
    return f"{'-' if value is None or not math.isfinite(value) else f'{value:.{digits}f}':>{width}}"
