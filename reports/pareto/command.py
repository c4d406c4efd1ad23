"""``headbench pareto``: reads finished runs, writes a table and a plot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

from ...bench.contracts import Progress, no_progress
from ...bench.io.files import write_text
from ...bench.runner.store import RunFolder
from ...bench.specs import Findings
from ..writers import csv_text
from .plot import Panel, write_plot
from .points import Point, pareto_front, read_points
from .settings import ParetoSettings
from .sweep import MARK

COSTS = {"megabytes": "Size, MB", "milliseconds": "Frame time, ms"}


def run(settings: ParetoSettings, progress: Progress = no_progress) -> Findings:
    """Write ``points.csv`` and ``pareto.png``. Raises `InputError` for runs that cannot be compared."""
    out = Path(settings.out)
    points, left_out, metric = read_points(
        [Path(r) for r in settings.runs], settings.task, settings.metric, settings.time
    )
    RunFolder(out).prepare()
    sign = 1.0 if metric.higher_is_better else -1.0
    fronts = {cost: _front(points, cost, sign, range(len(points))) for cost in COSTS}
    names = [field.name for field in fields(Point)]
    lines: list[list[object]] = [[*names, *(f"on_front_of_{cost}" for cost in COSTS)]]
    for index, point in enumerate(points):
        marks = [int(index in fronts[cost]) for cost in COSTS]
        lines.append([*(getattr(point, name) for name in names), *marks])
    write_text(out / "points.csv", csv_text(lines))
    unit = f", {metric.unit}" if metric.unit else ""
    labels = {
        **COSTS,
        **({"milliseconds": f"{settings.time.replace('_', ' ').capitalize()}, ms"} if settings.time else {}),
    }
    panels = [
        Panel(
            label,
            [getattr(p, cost) for p in points],
            [p.quality for p in points],
            fronts[cost],
            _series(points),
            [point.variant for point in points],
            {
                name: _front(points, cost, sign, [i for i, own in enumerate(_series(points)) if own == name])
                for name in _series(points)
            },
        )
        for cost, label in labels.items()
    ]
    machines = ", ".join(sorted({point.machine for point in points}))
    write_plot(
        out / "pareto.png", panels, f"{metric.label}{unit}, {settings.task.replace('_', ' ')}", machines
    )
    data = {"out": out, "points": [asdict(point) for point in points], "fronts": fronts, "left_out": left_out}
    return Findings(_text(points, fronts, left_out, metric.label, metric.digits), data)


def _front(points: Sequence[Point], cost: str, sign: float, among: Sequence[int]) -> list[int]:
    """Indices of the front of some points, those whose cost was measured."""
    known = [i for i in among if getattr(points[i], cost) is not None]
    front = pareto_front([getattr(points[i], cost) for i in known], [sign * points[i].quality for i in known])
    return [known[i] for i in front]


def _series(points: Sequence[Point]) -> list[str]:
    return [point.derived_from or point.method for point in points]


def _text(
    points: Sequence[Point], fronts: dict[str, list[int]], left_out: Sequence[str], label: str, digits: int
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
        lines.append(f"METHOD{MARK}VARIANT was derived from the trained avatar, without training.")
    return "\n".join([*lines, *(f"left out: {text}" for text in left_out)])
