"""The points of a curve, read from the run of all its trainings: a table, ``curve.csv`` and ``curve.png``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from ...bench.condition import Condition
from ...bench.contracts import Budget
from ...bench.engine.scoring import FULL
from ...bench.experiments.tracking import tracking_error
from ...bench.io.files import write_text
from ...bench.manifest import ClipRecord, MethodRecord
from ...bench.rows import ALL, Rows
from ...bench.specs import CommandResult, MetricSpec
from ..aggregate import subject_means
from ..runs import RunData
from ..writers import csv_text
from .plot import CurvePanel, write_plot
from .points import HELD_OUT, MEASURED, CurvePoint, column, mean, mean_point, points_text

TIMED = ("budget", "seconds")
"""Quantities whose axis is the measured training time."""
AXES = {
    "cameras": "Training cameras",
    "timesteps": "Training timesteps",
    "pictures": "Training pictures",
    "tracking_error": "Level of tracking error",
}


def curve_report(out: Path, over: str) -> CommandResult:
    """Write ``curve.csv`` and ``curve.png`` of the run in ``out``; return its points and a table of their means.

    Parameters
    ----------
    over : str
        Quantity that varies between the trainings: "budget", "seconds", "cameras", "timesteps", "pictures" or
        "tracking_error".

    Raises
    ------
    InputError
        The folder is not the run of a curve.
    """
    run = RunData.read(out)
    config = run.manifest.configuration
    conditions = {condition.name: condition for condition in config.conditions}
    tasks, metrics = run.tasks, run.metrics
    points = [
        _point(run, record, conditions[record.condition], clip)
        for record in run.manifest.methods
        for clip in run.manifest.clips
        if conditions[record.condition].clip.name == ("" if over in TIMED else over.replace("_", "-"))
    ]
    names = list(dict.fromkeys(point.method for point in points))
    order = [clip.subject for clip in run.manifest.clips]
    points.sort(key=lambda p: (names.index(p.method), p.place, order.index(p.subject)))
    groups: dict[tuple[str, tuple[float, ...]], list[CurvePoint]] = {}
    for point in points:
        groups.setdefault((point.method, point.place), []).append(point)
    means = [mean_point(group) for group in groups.values()]
    missing = {
        spec.label: _reason(run.rows, spec) for spec in metrics if spec.per_frame and _reason(run.rows, spec)
    }
    write_text(out / "curve.csv", csv_text(_lines(points)))
    clock = "processor_seconds" if config.device == "cpu" else "seconds"
    every = config.clip.parameters["every"]
    where = f"{every}th training timestep" if every > 2 else "second training timestep"
    axis = f"{'Processor seconds' if clock == MEASURED[0] else 'Seconds'} of training"
    axis = axis if over in TIMED else AXES[over]
    write_plot(
        out / "curve.png",
        [
            [
                _panel(means, spec, task, clock if over in TIMED else over, missing)
                for spec in metrics
                if spec.per_frame
            ]
            for task in tasks
        ],
        axis,
        f"Held out of every training: a training camera, every {where}. No test frame was looked at."
        + (f" Bars: 95 % intervals of the mean over {len(order)} subjects." if len(order) > 1 else ""),
    )
    held = {clip.subject: _step(clip.steps, "hold_out") for clip in run.manifest.clips}
    failed = run.rows.failed
    data = {
        "out": out,
        "held_out": held,
        "points": [point.flat() for point in points],
        "missing": missing,
        "failed": failed,
    }
    return CommandResult(points_text(means, metrics, tasks, held, missing, failed), data, not failed)


def _point(run: RunData, record: MethodRecord, condition: Condition, clip: ClipRecord) -> CurvePoint:
    seeds = run.manifest.configuration.seeds
    cells = [run.folder.cell(clip.subject, record.label, seed) for seed in seeds]
    records: list[Mapping[str, Any]] = [cell.step("fit") or {} for cell in cells]
    cost = {key: mean([_number(each.get(key)) for each in records]) for key in MEASURED}
    values: dict[str, float | None] = {}
    for spec in run.metrics:
        for task in run.tasks if spec.per_frame else ("",):
            chosen = run.rows.select(
                method=record.label, metric=spec.name, task=task, region=FULL, seeds=ALL, subject=clip.subject
            )
            whole = len(chosen) and (chosen["status"] == "ok").all()
            values[column(spec, task)] = subject_means(chosen)[clip.subject] if whole else None
    added = next(
        (a.steps for a in run.manifest.adapted if (a.subject, a.method) == (clip.subject, record.label)), []
    )
    given = {**_step(clip.steps, "hold_out")["training"], **_step(added, "reduce_training")}
    part = condition.part if condition.part != 1 else Fraction(condition.clip.parameters.get("part", "1"))
    budget, level = Budget(**record.budget), condition.clip.parameters.get("level")
    asked = float(condition.clip.parameters.get("count", 0))
    return CurvePoint(
        record.name,
        clip.subject,
        (float(part), budget.seconds or 0.0, asked, level or 0.0),
        part,
        budget,
        len(given["cameras"]),
        len(given["timesteps"]),
        given.get("count", clip.splits["train"]),
        tracking_error(clip.steps) if level is None else level,
        cost,
        values,
        {},
    )


def _step(steps: Sequence[Mapping[str, Any]], name: str) -> Mapping[str, Any]:
    """Parameters of a processing step, empty if it was not applied."""
    return next((step["parameters"] for step in steps if step["name"] == name), {})


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, (int, float)) else None


def _reason(rows: Rows, spec: MetricSpec) -> str:
    """Reason why a metric was not measured; "" if it was, or if trainings failed."""
    own = rows.select(method=ALL, metric=spec.name, task=ALL, region=FULL, seeds=ALL)
    reasons = own.loc[own["status"] == "missing", "reason"]
    return " ".join(str(reasons.iloc[0]).split()) if len(reasons) else ""


def _panel(
    points: Sequence[CurvePoint], spec: MetricSpec, task: str, axis: str, missing: Mapping[str, str]
) -> CurvePanel:
    """Quality over the horizontal axis: a field of `CurvePoint` or a cost."""
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
