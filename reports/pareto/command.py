"""``headbench report pareto``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_output_folder, write_text
from ...bench.progress import counted
from ...bench.specs import CommandResult, command
from ...bench.terminal import table
from .settings import ParetoSettings

if TYPE_CHECKING:
    from ...bench.specs import MetricSpec
    from .points import ParetoPoint, RateDifference, RatePoint


COSTS = {"megabytes": "Size, MB", "milliseconds": "Frame time, ms"}


@command("report pareto", group="inspect", writes="out")
def pareto_runs(settings: ParetoSettings, progress: Progress = no_progress) -> CommandResult:
    """Plot quality against size and frame time of runs, with the Pareto front."""
    out = Path(settings.out)
    return pareto(settings.runs, out, settings.task, settings.metric, settings.time, settings.reference)


def pareto(
    runs: Sequence[str], out: Path, task: str, metric_name: str = "", time: str = "", reference: str = ""
) -> CommandResult:
    """Write ``points.csv`` and ``pareto.png`` of finished runs, and ``rates.csv`` and ``rate_distortion.png`` if they have
    coded avatars at several steps. Runs of different subjects are joined. Raises `InputError` for runs that cannot be compared."""
    from ..runs import RunData, joined_subjects
    from ..writers import csv_text
    from .plot import write_plot
    from .points import ParetoPoint, front_of, read_points, read_rates

    read = joined_subjects([RunData.read(Path(run)) for run in runs])
    points, left_out, metric, note = read_points(read, task, metric_name, time)
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
    rates: list[RateDifference] = []
    try:
        curves = read_rates(read, task)
    except InputError as error:
        left_out.append(f"curves of rate and distortion: {error}")
    else:
        rates = _rates(*curves, out, task, reference)
    data = {
        "out": out,
        "points": [asdict(point) for point in points],
        "fronts": fronts,
        "left_out": left_out,
        "note": note,
        "rates": [asdict(rate) for rate in rates],
    }
    text = _text(points, fronts, left_out, metric.label, metric.digits, note)
    names = ["points.csv", "pareto.png", *(("rates.csv", "rate_distortion.png") if rates else ())]
    written = ", ".join(str(out / name) for name in names)
    return CommandResult("\n".join([text, *map(_rate_text, rates), f"Written: {written}"]), data)


def _rates(
    points: Sequence[RatePoint], metrics: Sequence[MetricSpec], out: Path, task: str, reference: str
) -> list[RateDifference]:
    """Write the files of rate and distortion; return the differences to the reference, none with fewer than two steps."""
    from ..writers import csv_text
    from .plot import write_rates
    from .points import rate_differences

    methods = list(dict.fromkeys(point.method for point in points))
    if reference and reference not in methods:
        raise InputError("command line", "--reference", ", ".join(methods) or "coded avatars", reference)
    if not metrics or len({point.variant for point in points if point.variant}) < 2:
        return []
    names = [metric.name for metric in metrics]
    lines: list[list[object]] = [["method", "variant", "subject", "megabytes", *names]]
    for point in points:
        for subject, size in point.megabytes.items():
            values = [point.quality[name].get(subject, "") for name in names]
            lines.append([point.method, point.variant, subject, size, *values])
    write_text(out / "rates.csv", csv_text(lines))
    write_rates(out / "rate_distortion.png", points, metrics, task)
    return rate_differences(points, metrics, reference or methods[0])


def _rate_text(rate: RateDifference) -> str:
    """A line of the report."""
    name = f"BD-rate by {rate.metric}, {rate.method} against {rate.reference}:"
    if rate.percent is None:
        return f"{name} none ({rate.reason})"
    bounds = f"no interval of {counted(rate.subjects, 'subject')}"
    if rate.low is not None and rate.high is not None:
        bounds = f"95 % interval over {rate.subjects} subjects {rate.low:+.1f} to {rate.high:+.1f} %"
    return f"{name} {rate.percent:+.1f} % ({bounds})"


def _text(
    points: Sequence[ParetoPoint],
    fronts: dict[str, list[int]],
    left_out: Sequence[str],
    label: str,
    digits: int,
    note: str,
) -> str:
    rows = []
    for index, point in enumerate(points):
        costs = [
            f"{'-' if value is None else f'{value:.2f}'}{' *' if index in fronts[cost] else ''}"
            for cost, value in (("megabytes", point.megabytes), ("milliseconds", point.milliseconds))
        ]
        rows.append([point.method, f"{point.quality:.{digits}f}", *costs, point.run])
    lines = [table(["method", label, "MB", "ms", "run"], rows), "* On the front of size or time."]
    if any(point.derived_from for point in points):
        lines.append("METHOD+VARIANT was derived from the trained avatar, without training.")
    lines += [f"Frame times: {note}"] if note else []
    return "\n".join([*lines, *(f"left out: {text}" for text in left_out)])
