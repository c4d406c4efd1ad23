"""Rate and distortion of stored runs as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

from ...bench.condition import label_of
from ...bench.errors import InputError
from ...bench.protocol import TASK_TITLES
from ...bench.specs import MetricSpec
from ..runs import RunData
from ..writers import pipe_table
from .rates import RateDifference, RatePoint, by_subject, rate_differences, read_rates

PER_PRIMITIVE = "primitive_bytes"


def rate_tables(runs: Sequence[RunData], tasks: Sequence[str], reference: str) -> str:
    """Bytes and losses of each method at each step of the codec, means over subjects, and BD-rates to a method: Markdown.

    Losses are differences from the same avatars as trained. Raises `InputError` if a value of a subject is missing.
    """
    found = {task: read_rates(runs, task) for task in tasks}
    subjects = {subject for run in runs for subject in run.rows.subjects}
    for task, (own, _) in found.items():
        for point in own:
            for what, values in {"storage": point.megabytes, **point.quality}.items():
                if missing := sorted(subjects - values.keys()):
                    key = f"{point.method}, {point.variant or 'as trained'}, {task}"
                    raise InputError(
                        runs[0].folder.root, key, f"{what} of every subject", f"none of {missing[0]}"
                    )
    points = {
        task: {(point.method, point.variant): point for point in own} for task, (own, _) in found.items()
    }
    metrics = found[tasks[0]][1]
    columns = [(task, metric) for metric in metrics for task in tasks]
    titles = [f"{metric.label}, {TASK_TITLES[task].lower()}" for task, metric in columns]
    lines = [
        ["method", "codec", "MB", "bytes per primitive", *titles],
        [":--", ":--", *["--:"] * (2 + len(titles))],
    ]
    methods = [method for method, _ in points[tasks[0]]]
    sizes = {key: fmean(point.megabytes.values()) for key, point in points[tasks[0]].items()}
    for method, variant in sorted(sizes, key=lambda key: (methods.index(key[0]), -sizes[key])):
        label = label_of(method, variant)
        per_primitive = [size for run in runs for size in by_subject(run, label, PER_PRIMITIVE, "").values()]
        lines.append(
            [
                method,
                variant or "none",
                f"{sizes[method, variant]:.2f}",
                f"{fmean(per_primitive):.1f}" if per_primitive else "–",
                *(_change(points[task], method, variant, metric) for task, metric in columns),
            ]
        )
    differences = [
        [rate.method, TASK_TITLES[task].lower(), metric.label, *_cells(rate)]
        for task, (own, metrics) in found.items()
        for metric in metrics
        for rate in rate_differences(own, [metric], reference)
    ]
    rates = [
        ["method", "task", "quality", f"BD-rate to `{reference}`", "95 % interval"],
        [":--", ":--", ":--", "--:", "--:"],
        *differences,
    ]
    return f"{pipe_table(lines)}\n\n{pipe_table(rates)}"


def _change(points: dict[tuple[str, str], RatePoint], method: str, variant: str, metric: MetricSpec) -> str:
    """Mean over subjects of a metric, for coded avatars less that of the avatars as trained."""
    trained, own = (points[method, each].quality[metric.name] for each in ("", variant))
    if not variant:
        return f"{fmean(own.values()):.{metric.digits}f}"
    return f"{fmean(own[subject] - trained[subject] for subject in own):+.{metric.digits}f}"


def _cells(rate: RateDifference) -> tuple[str, str]:
    if rate.percent is None:
        return "–", rate.reason
    if rate.low is None or rate.high is None:
        return f"{rate.percent:+.0f} %", "–"
    return f"{rate.percent:+.0f} %", f"{rate.low:+.0f} to {rate.high:+.0f} %"
