"""``headbench report pareto``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING

from ...bench.contracts import Progress, no_progress
from ...bench.io.files import check_output_folder, write_text
from ...bench.specs import CommandResult
from .settings import ParetoSettings

if TYPE_CHECKING:
    from .points import ParetoPoint


COSTS = {"megabytes": "Size, MB", "milliseconds": "Frame time, ms"}


def pareto_runs(settings: ParetoSettings, progress: Progress = no_progress) -> CommandResult:
    """Plot quality against size and frame time of finished runs, with the Pareto front, and write CSV."""
    return pareto(settings.runs, Path(settings.out), settings.task, settings.metric, settings.time)


def pareto(runs: Sequence[str], out: Path, task: str, metric_name: str = "", time: str = "") -> CommandResult:
    """Write ``points.csv`` and ``pareto.png`` of finished runs. Raises `InputError` for runs that cannot be compared."""
    from ..writers import csv_text
    from .plot import write_plot
    from .points import ParetoPoint, front_of, read_points

    points, left_out, metric, note = read_points([Path(r) for r in runs], task, metric_name, time)
    check_output_folder(out)
    rising = metric.higher_is_better
    fronts = {cost: front_of(points, cost, higher_is_better=rising) for cost in COSTS}
    names = [field.name for field in fields(ParetoPoint)]
    lines: list[list[object]] = [[*names, *(f"on_front_of_{cost}" for cost in COSTS)]]
    for index, point in enumerate(points):
        marks = [int(index in fronts[cost]) for cost in COSTS]
        lines.append([*(getattr(point, name) for name in names), *marks])
    write_text(out / "points.csv", csv_text(lines))
    unit = f", {metric.unit}" if metric.unit else ""
    labels = dict(COSTS)
    if time:
        labels["milliseconds"] = f"{time.replace('_', ' ').capitalize()}, ms"
    quality = f"{metric.label}{unit}, {task.replace('_', ' ')}"
    write_plot(out / "pareto.png", points, labels, quality, higher_is_better=rising)
    data = {
        "out": out,
        "points": [asdict(point) for point in points],
        "fronts": fronts,
        "left_out": left_out,
        "note": note,
    }
    return CommandResult(_text(points, fronts, left_out, metric.label, metric.digits, note), data)


def _text(
    points: Sequence[ParetoPoint],
    fronts: dict[str, list[int]],
    left_out: Sequence[str],
    label: str,
    digits: int,
    note: str,
) -> str:
    wide = max([16, *(len(point.method) + 2 for point in points)])
    lines = [f"{'method':<{wide}}{label:>10}{'MB':>12}{'ms':>12}  run (* on the front of size, of time)"]
    for index, point in enumerate(points):
        cells = [
            f"{'-' if value is None else f'{value:.2f}':>10} {'*' if index in fronts[cost] else ' '}"
            for cost, value in (("megabytes", point.megabytes), ("milliseconds", point.milliseconds))
        ]
        lines.append(f"{point.method:<{wide}}{point.quality:>10.{digits}f}{''.join(cells)}  {point.run}")
    if any(point.derived_from for point in points):
        lines.append("METHOD+VARIANT was derived from the trained avatar, without training.")
    lines += [f"Frame times: {note}"] if note else []
    return "\n".join([*lines, *(f"left out: {text}" for text in left_out)])
