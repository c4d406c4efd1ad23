"""Trains the methods of a run with parts of their budgets and measures them on held-out training frames."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any

from ...bench.contracts import Budget, Clip
from ...bench.errors import InputError
from ...bench.io.files import write_text
from ...bench.machine import check_device
from ...bench.manifest import MethodRecord
from ...bench.protocol import Protocol, make_protocols
from ...bench.rows import ALL, Rows, earlier_rows
from ...bench.runner.captures import open_run_clips, run_configuration
from ...bench.runner.config import ResolvedMethod, RunConfig, resolve_methods, resolve_metrics
from ...bench.runner.run import describe, make_jobs, run_jobs, warn_of_missing_metrics
from ...bench.runner.scoring import FULL
from ...bench.runner.steps import Job
from ...bench.runner.store import RunFolder
from ...bench.runner.stored import VARIANT_MARK
from ...bench.specs import Findings, MetricSpec
from ..aggregate import subject_means
from ..writers import csv_text
from .held_out import CAMERA, TIMESTEPS, HeldOutClip, hold_out, reduced
from .plot import CurvePanel, write_plot
from .points import HELD_OUT, MEASURED, CurvePoint, column, mean, mean_point, points_text
from .settings import CurveSettings
from .tracking import clips_by_level, tracking_error

log = logging.getLogger(__name__)
AXES = {
    "cameras": "Training cameras",
    "timesteps": "Training timesteps",
    "tracking_error": "Level of tracking error",
}
METRICS: tuple[str, ...] = ("psnr", "ssim", "lpips", "storage", "primitives")
"""Metrics of a curve, whether the run took them or not, as the canonical profile defines them."""


def curve(settings: CurveSettings, out: Path) -> Findings:
    """Train, measure, write ``curve.csv`` and ``curve.png`` into ``out``, whose lock is held; return points and a table.

    Started again, it keeps trainings that ended. One that was interrupted begins again, since its time is asked for.

    Raises
    ------
    InputError
        For a method that the run does not have or that has no budget, a capture that is not the run's or has too few
        frames to hold some out, and a folder with trainings of other settings, or with some that would be left out.
    """
    run = RunFolder(Path(settings.run))
    wanted = _wanted(settings, run)
    config, clips = open_run_clips(run.root, settings, out=out)
    programs = [method.spec.name for method in wanted if not method.spec.native]
    if programs and not settings.trust:
        expected = "methods that run no program which the run folder names"
        remedy = "Give --trust to run it, if you trust who made the run; or name other methods."
        raise InputError(run.manifest, "configuration.settings", expected, ", ".join(programs), remedy)
    check_device(config.device)
    held = [hold_out(clip, settings.camera, settings.every) for clip in clips]
    tasks = tuple(task for task in (CAMERA, TIMESTEPS) if all(task in clip.splits for clip in held))
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
    hashes = [protocol.hash for protocol in protocols.values()]
    earlier = earlier_rows(folder.rows)
    if earlier is not None and settings.over == "tracking_error":
        # Before the tracking of new levels is written.
        names = [
            f"{method.spec.name}{VARIANT_MARK}{_of_level(level)}"
            for method, level in product(wanted, settings.tracking_errors)
        ]
        earlier.check_kept(folder.rows, method=names, protocol=hashes)
    trainings = _trainings(config, settings, wanted, held, protocols, run, folder)
    jobs = [job for training in trainings for job in training.jobs]
    for job in jobs:
        job.check()
        job.check_method()
    if earlier is not None:
        earlier.check_kept(
            folder.rows,
            method=dict.fromkeys(job.method.spec.name for job in jobs),
            seed=config.seeds,
            protocol=hashes,
        )
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
    folder.write_rows(rows)
    replace(manifest, status="done").write(folder.manifest)

    names, order = [m.spec.name for m in wanted], [clip.subject for clip in clips]
    trainings.sort(
        key=lambda t: (
            names.index(t.method.spec.name),
            t.part,
            tracking_error(t.clip) or 0.0,
            order.index(t.clip.subject),
        )
    )
    points = [_point(training, rows, metrics, tasks) for training in trainings]
    groups: dict[tuple[str, Fraction, float | None], list[CurvePoint]] = {}
    for point in points:
        groups.setdefault((point.method, point.part, point.tracking_error), []).append(point)
    means = [mean_point(group) for group in groups.values()]
    missing = {spec.label: _reason(rows, spec) for spec in metrics if spec.per_frame and _reason(rows, spec)}
    write_text(out / "curve.csv", csv_text(_lines(points)))
    clock = "processor_seconds" if config.device == "cpu" else "seconds"
    where = f"{settings.every}th training timestep" if settings.every > 2 else "second training timestep"
    axis = f"{'Processor seconds' if clock == MEASURED[0] else 'Seconds'} of training"
    axis = axis if settings.over == "budget" else AXES[settings.over]
    write_plot(
        out / "curve.png",
        [
            [
                _panel(means, spec, task, clock if settings.over == "budget" else settings.over, missing)
                for spec in metrics
                if spec.per_frame
            ]
            for task in tasks
        ],
        axis,
        f"Held out of every training: a training camera, every {where}. No test frame was looked at."
        + (f" Bars: 95 % intervals of the mean over {len(clips)} subjects." if len(clips) > 1 else ""),
    )
    data = {
        "out": out,
        "held_out": {clip.subject: clip.steps[-1].parameters for clip in held},
        "points": [point.flat() for point in points],
        "missing": missing,
        "failed": rows.failed,
    }
    return Findings(points_text(means, metrics, tasks, held, missing, rows.failed), data, not rows.failed)


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


@dataclass(frozen=True)
class _Given:
    """What a training is given: ``part`` of its budget or of the frames, and ``clips``, one for each subject."""

    name: str
    part: Fraction
    clips: Sequence[HeldOutClip]


@dataclass(frozen=True)
class _Training:
    """A method with its whole budget, and what it is given of that and of the frames: a job for each seed."""

    method: ResolvedMethod
    part: Fraction
    clip: HeldOutClip
    jobs: tuple[Job, ...]


def _given(settings: CurveSettings, config: RunConfig, held: Sequence[HeldOutClip]) -> Iterator[_Given]:
    """What the trainings are given besides parts of their budgets; the whole first."""
    if settings.over == "budget":
        yield _Given("", Fraction(1), held)
    elif settings.over == "tracking_error":
        for level, clips in clips_by_level(config, [clip.source for clip in held], settings.tracking_errors):
            found = [hold_out(clip, settings.camera, settings.every) for clip in clips]
            yield _Given(_of_level(level), Fraction(1), found)
    else:
        for part in reversed(settings.parts):
            yield _Given(_named(part), part, [reduced(clip, settings.over, part) for clip in held])


def _of_level(level: float) -> str:
    return f"tracking-{level:g}"


def _named(part: Fraction) -> str:
    return str(part).replace("/", "-")


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
    found: list[_Training] = []
    different: dict[tuple[str, ...], _Given] = {}
    for given in _given(settings, config, held):
        different.setdefault(tuple(clip.fingerprint for clip in given.clips), given)
    for given in different.values():
        bases = make_jobs(config, wanted, given.clips, protocols, run, folder.root)
        for method, (clip, whole) in product(wanted, zip(given.clips, held)):
            parts = {method.budget: given.part}
            if settings.over == "budget":
                parts = _budgets(method.budget, settings.parts)
            own = [job for job in bases if (job.clip, job.method.spec.name) == (clip, method.spec.name)]
            for budget, part in reversed(parts.items()):
                # The frames to measure are those of all trainings, whatever each is given.
                jobs = [job if clip is whole else replace(job, clip=whole, adapted=job.form) for job in own]
                name = given.name or _named(part)
                named = tuple(job.variant(name, folder, budget=budget) for job in jobs)
                found.append(_Training(method, part, clip, named))
    return found


def _drop_interrupted(job: Job) -> None:
    """Remove what a killed training left, so that it begins again and its time is known."""
    state = job.cell.step("fit")
    if state is not None and state["status"] != "done":
        if job.cell.avatar.exists():
            log.info("%s: its training was interrupted; it begins again", job.name)
            shutil.rmtree(job.cell.avatar)
        (job.cell.folder / "fit.json").unlink()


def _point(
    training: _Training, rows: Rows, metrics: Sequence[MetricSpec], tasks: Sequence[str]
) -> CurvePoint:
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
            values[column(spec, task)] = subject_means(chosen)[subject] if whole else None
    keys = training.clip.splits["train"]
    cameras, timesteps = (len({getattr(key, name) for key in keys}) for name in ("camera", "timestep"))
    method = training.method.spec.name
    level = tracking_error(training.clip)
    return CurvePoint(
        method, subject, training.part, job.method.budget, cameras, timesteps, level, cost, values, {}
    )


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, (int, float)) else None


def _reason(rows: Rows, spec: MetricSpec) -> str:
    """Why a metric was not measured; "" where it was, or where trainings failed."""
    own = rows.select(method=ALL, metric=spec.name, task=ALL, region=FULL, seeds=ALL)
    reasons = own.loc[own["status"] == "missing", "reason"]
    return " ".join(str(reasons.iloc[0]).split()) if len(reasons) else ""


def _panel(
    points: Sequence[CurvePoint], spec: MetricSpec, task: str, axis: str, missing: Mapping[str, str]
) -> CurvePanel:
    """Quality over what the horizontal axis has: a field of `CurvePoint` or a cost."""
    lines: dict[str, list[tuple[float, float, float]]] = {}
    for point in points:
        cost = point.cost[axis] if axis in point.cost else getattr(point, axis)
        value, half = point.values[column(spec, task)], point.halves[column(spec, task)]
        line = lines.setdefault(point.method, [])
        if cost is not None and value is not None:
            cost = max(cost, 1e-3) if axis in point.cost else cost  # recorded to a millisecond
            line.append((cost, value, half or 0.0))
    unit = f", {spec.unit}" if spec.unit else ""
    title = f"{spec.label}{unit}, held-out {HELD_OUT[task]}"
    return CurvePanel(title, lines, missing.get(spec.label, ""))


def _lines(points: Sequence[CurvePoint]) -> list[list[object]]:
    flat = [point.flat() for point in points]
    return [[*flat[0]], *([*line.values()] for line in flat)]
