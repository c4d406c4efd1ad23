"""Points of a curve: cost and quality of trainings, means over subjects, and their table and text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from statistics import fmean
from typing import Any

from ...bench.contracts import Budget
from ...bench.specs import MetricSpec
from ...bench.terminal import table
from ..statistics.comparisons import LEAST_SUBJECTS, half_width

HELD_OUT: Mapping[str, str] = {"novel_view": "camera", "self_reenactment": "timesteps"}
"""Held-out data by task."""
MEASURED: Mapping[str, tuple[str, float]] = {
    "processor_seconds": ("training_processor", 1.0),
    "seconds": ("training_time", 60.0),
    "peak_memory_bytes": ("training_memory", 1e9),
}
"""Metric of each cost of a training, and its factor."""


@dataclass(frozen=True)
class CurvePoint:
    """A method trained with a part of its budget or of the frames, or with a level of tracking error.

    ``place`` orders and identifies the points of a method. Values are means over seeds of one subject, or over subjects ("").
    ``cameras``, ``timesteps`` and ``pictures`` count the training data. ``tracking_error`` is the level of a synthetic capture, None
    for a recording. ``cost`` is `MEASURED` by name, ``values`` are the metrics by name and held-out data, such as "psnr_camera";
    None: not measured. ``halves`` are half the widths of the 95 % intervals of means over subjects, by the same names, None with
    fewer than `LEAST_SUBJECTS`.
    """

    method: str
    subject: str
    place: tuple[float, ...]
    part: Fraction
    budget: Budget
    cameras: float
    timesteps: float
    pictures: float
    tracking_error: float | None
    cost: Mapping[str, float | None]
    values: Mapping[str, float | None]
    halves: Mapping[str, float | None]

    def flat(self) -> dict[str, object]:
        """The point as a line of ``curve.csv``, by column."""
        budget = asdict(self.budget)
        return {
            "method": self.method,
            "subject": self.subject,
            "fraction": float(self.part),
            "budget_iterations": budget["iterations"],
            "budget_seconds": budget["seconds"],
            "cameras": self.cameras,
            "timesteps": self.timesteps,
            "pictures": self.pictures,
            "tracking_error": self.tracking_error,
            **self.cost,
            **self.values,
        }


def mean(values: Sequence[float | None]) -> float | None:
    """Mean of numbers; None if any is missing or there are none."""
    known = [value for value in values if value is not None]
    return fmean(known) if known and len(known) == len(values) else None


def _half_width(values: Sequence[float | None]) -> float | None:
    """Half the width of the interval of a mean; None for fewer than `LEAST_SUBJECTS` numbers or a missing one."""
    known = [value for value in values if value is not None]
    return half_width(known) if LEAST_SUBJECTS <= len(known) == len(values) else None


def mean_point(points: Sequence[CurvePoint]) -> CurvePoint:
    """The mean over subjects of points that are otherwise equal."""
    first = points[0]
    by_name = {key: [point.values[key] for point in points] for key in first.values}
    cameras, timesteps, pictures = (
        fmean(getattr(point, name) for point in points) for name in ("cameras", "timesteps", "pictures")
    )
    return replace(
        first,
        subject="",
        cameras=cameras,
        timesteps=timesteps,
        pictures=pictures,
        cost={key: mean([point.cost[key] for point in points]) for key in first.cost},
        values={key: mean(values) for key, values in by_name.items()},
        halves={key: _half_width(values) for key, values in by_name.items()},
    )


def column(spec: MetricSpec, task: str) -> str:
    """Name of a metric's value in `CurvePoint.values`."""
    return f"{spec.name}_{HELD_OUT[task]}" if task in HELD_OUT else spec.name


def points_text(
    points: Sequence[CurvePoint],
    metrics: Sequence[MetricSpec],
    tasks: Sequence[str],
    held: Mapping[str, Mapping[str, Any]],
    missing: Mapping[str, str],
    failed: Sequence[str],
) -> str:
    """Means over subjects as a table, with the held-out data and the missing values."""
    frame = [spec for spec in metrics if spec.per_frame]
    costs = {name for name, _ in MEASURED.values()}
    avatar = [spec for spec in metrics if not spec.per_frame and spec.name not in costs]
    tracked = any(point.tracking_error is not None for point in points)
    place = ["method", "part", "budget"]
    heads = [*place, "cameras", "timesteps", "pictures", *["tracking"] * tracked, "CPU s", "s"]
    heads += [f"{spec.label} {spec.unit}".rstrip() for spec in avatar]
    trainings: list[list[str]] = []
    quality: dict[str, list[list[str]]] = {task: [] for task in tasks if frame}
    for point in points:
        budget = point.budget
        size = f"{budget.seconds:g} s" if budget.iterations is None else f"{budget.iterations}"
        where = [point.method, str(point.part), size]
        cells = [f"{count:g}" for count in (point.cameras, point.timesteps, point.pictures)]
        cells += [_shown(point.tracking_error, 2)] * tracked
        cells += [_shown(point.cost[key], 1) for key in ("processor_seconds", "seconds")]
        cells += [_shown(point.values[spec.name], spec.digits) for spec in avatar]
        trainings.append([*where, *cells])
        for task, own in quality.items():
            own.append([*where, *(_shown(point.values[column(spec, task)], spec.digits) for spec in frame)])
    lines = [table(heads, trainings, names=3, title="Trainings"), ""]
    for task, own in quality.items():
        title = f"Quality, held-out {HELD_OUT[task]}"
        lines += [table([*place, *(spec.label for spec in frame)], own, names=3, title=title), ""]
    lines.append("Means over subjects. Held out of every training; no test frame was used:")
    for subject, parameters in held.items():
        steps = ", ".join(map(str, parameters["timesteps"][:6])) + (
            ", ..." if len(parameters["timesteps"]) > 6 else ""
        )
        lines.append(f"  {subject}: camera {parameters['camera'] or 'none'}, timesteps {steps or 'none'}")
    lines += [f"{label} missing: {reason}" for label, reason in missing.items()]
    return "\n".join([*lines, *(f"failed: {name}" for name in failed)])


def _shown(value: float | None, digits: int) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
