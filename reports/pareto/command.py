"""``headbench report pareto``."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.transforms import Bbox

from ...bench.condition import label_of
from ...bench.contracts import Progress, no_progress
from ...bench.engine.config import CODED
from ...bench.errors import InputError
from ...bench.io.files import check_output_folder, write_text
from ...bench.progress import counted
from ...bench.protocol import TASK_TITLES
from ...bench.specs import CommandResult, MetricSpec, command
from ...bench.terminal import table
from ..aggregate import Conditions, conditions, note_of, subject_means, summarise, whole_images
from ..drawing import GREY, MARKERS, TEXT_POINTS, cost_axis, plot_file, show_missing, start_axes
from ..runs import RunData, check_same_protocol, joined_subjects, training_labels
from ..statistics.comparisons import LEAST_SUBJECTS, half_width
from ..writers import csv_text

Curve = Sequence[tuple[float, float]]
"""Megabytes and quality at each step of the codec."""
LEAST_POINTS = 3
"""Minimum number of steps of a curve."""
METRICS = ("psnr", "lpips")


def pareto_front(costs: Sequence[float], qualities: Sequence[float]) -> list[int]:
    """Indices of the points on the Pareto front, by increasing cost.

    One point dominates another if it costs no more and is no worse, and is strictly better in one of the two. Equal
    points do not dominate each other. Lower costs and higher qualities are better; all numbers are finite.
    """
    front: list[int] = []
    for index in sorted(range(len(costs)), key=lambda i: (costs[i], -qualities[i])):
        point = qualities[index], costs[index]
        last = (qualities[front[-1]], costs[front[-1]]) if front else None
        if last is None or point[0] > last[0] or point == last:
            front.append(index)
    return front


SIZE, SPEED, LATENCY = "storage", "fps", "latency_p50"


@dataclass(frozen=True)
class ParetoPoint:
    """One method of one run, means over frames, subjects and seeds."""

    run: str
    method: str
    derived_from: str  # "" for a trained avatar, likewise the variant
    variant: str
    quality: float
    megabytes: float | None  # None: not measured
    milliseconds: (
        float | None
    )  # median frame time, or the inverse of the mean rate; None: neither was measured
    machine: str

    @property
    def series(self) -> str:
        """The method that was trained."""
        return self.derived_from or self.method


def front_of(
    points: Sequence[ParetoPoint], cost: str, *, higher_is_better: bool, series: str | None = None
) -> list[int]:
    """Indices of the front of all points, or of one series, whose cost (a field of `ParetoPoint`) was measured."""
    costs = {i: getattr(point, cost) for i, point in enumerate(points) if series in (None, point.series)}
    measured = [i for i, value in costs.items() if value is not None]
    sign = 1.0 if higher_is_better else -1.0
    front = pareto_front([costs[i] for i in measured], [sign * points[i].quality for i in measured])
    return [measured[i] for i in front]


def read_points(
    runs: Sequence[RunData], task: str, metric: str, time: str = ""
) -> tuple[list[ParetoPoint], list[str], MetricSpec, str]:
    """Every method of every run except trivial baselines, as points; return these, omitted methods with reasons,
    the metric, and a note on frame times that are not comparable ("": all are).

    ``metric`` "" is the first of frames that the runs have; ``time`` names the metric of milliseconds; "" the
    median latency, or the inverse of the frames per second.
    """
    points: list[ParetoPoint] = []
    left_out: list[str] = []
    timings: dict[str, Conditions] = {}
    spec = None
    for data in runs:
        folder = data.folder.root
        data.rows.check()
        if task not in data.tasks:
            raise InputError(folder, "task", ", ".join(data.tasks), task)
        of_frames = {m.name: m for m in data.manifest.metrics if m.per_frame}
        metric = metric or next(iter(of_frames), "")
        if metric not in of_frames:
            raise InputError(folder, "metric", f"a metric of frames: {', '.join(of_frames)}", metric)
        spec = spec or of_frames[metric]
        times = [m.name for m in data.manifest.metrics if m.unit == "ms"]
        if time and time not in times:
            raise InputError(folder, "time", f"a metric in ms: {', '.join(times) or 'none'}", time)
        check_same_protocol(runs[0], data, task)
        measured = conditions(data.rows, data.manifest.metrics, data.methods)
        derived = {c.name for c in data.manifest.configuration.conditions if c.derive}
        for record in data.manifest.methods:
            if record.trivial:
                continue
            label = record.label
            quality, size, speed, latency = (
                summarise(data.rows, label, name, where)
                for name, where in ((metric, task), (SIZE, ""), (SPEED, ""), (time or LATENCY, ""))
            )
            if quality.value is None:
                left_out.append(f"{label} of {folder}: {quality.reason}")
                continue
            milliseconds, timed = latency.value, time or LATENCY
            if milliseconds is None and not time and speed.value:
                milliseconds, timed = 1000.0 / speed.value, SPEED
            if milliseconds is not None and label in measured.get(timed, {}):
                timings[label if len(runs) == 1 else f"{label} of {folder}"] = measured[timed][label]
            source, variant = (record.name, record.condition) if record.condition in derived else ("", "")
            costs = size.value, milliseconds
            points.append(
                ParetoPoint(str(folder), label, source, variant, quality.value, *costs, data.machine)
            )
    if spec is None or not points:
        expected = "a method, no trivial baseline, with a value"
        raise InputError("runs", "", expected, "; ".join(left_out) or "none")
    return points, left_out, spec, note_of(timings)


@dataclass(frozen=True)
class RatePoint:
    """A method's coded avatars at one step (``variant``), or those as trained (""): megabytes and quality by subject."""

    method: str
    variant: str
    megabytes: Mapping[str, float]
    quality: Mapping[str, Mapping[str, float]]  # by metric and subject

    def mean(self, metric: str) -> tuple[float, float] | None:
        """Megabytes and quality, means over subjects; None where a subject has no value."""
        values = self.quality.get(metric, {})
        if not self.megabytes or set(values) != set(self.megabytes):
            return None
        return float(np.mean([*self.megabytes.values()])), float(np.mean([*values.values()]))


@dataclass(frozen=True)
class RateDifference:
    """Bjontegaard difference of a method to a reference, percent; negative: fewer bytes at equal quality."""

    method: str
    reference: str
    metric: str
    percent: float | None
    low: float | None = None  # of the 95 % interval over subjects, by Student's t of the logarithm
    high: float | None = None
    subjects: int = 0
    reason: str = ""  # why there is no ``percent``


def read_rates(runs: Sequence[RunData], task: str) -> tuple[list[RatePoint], list[MetricSpec]]:
    """Coded avatars of runs at their steps, and the metrics of `METRICS` that the runs have; empty without coded ones.

    Several runs may have different steps of one method; a method whose values differ between them has a curve for each
    training, named as in a `RunSet`. Raises `InputError` for two runs with different values of the same training. Runs of
    different subjects are joined before (`runs.joined_subjects`).
    """
    measured: list[tuple[int, RatePoint]] = []
    metrics = [m for m in runs[0].manifest.metrics if m.name in METRICS and m.per_frame] if runs else []
    for index, run in enumerate(runs):
        derived = {c.name for c in run.manifest.configuration.conditions if c.derive}
        steps = {name for name in derived if name == CODED or name.startswith(f"{CODED}-x")}
        for record in run.manifest.methods:
            if record.trivial or (record.condition and record.condition not in steps):
                continue
            sizes = _by_subject(run, record.label, SIZE, "")
            quality = {metric.name: _by_subject(run, record.label, metric.name, task) for metric in metrics}
            measured.append((index, RatePoint(record.name, record.condition, sizes, quality)))
    first = {(point.method, point.variant): point for _, point in reversed(measured)}
    differing = {point.method for _, point in measured if point != first[point.method, point.variant]}
    labels = training_labels(runs) if differing else []
    points: dict[tuple[str, str], RatePoint] = {}
    for index, point in measured:
        if point.method in differing:
            point = replace(point, method=labels[index].get(point.method, point.method))
        if points.setdefault((point.method, point.variant), point) != point:
            folder, label = runs[index].folder.root, label_of(point.method, point.variant)
            expected = f"the values of {label} in another run"
            raise InputError(folder, "method", expected, "other values", "Give one of the runs.")
    coded = {point.method for point in points.values() if point.variant}
    return [point for point in points.values() if point.method in coded], metrics


def _by_subject(run: RunData, label: str, metric: str, task: str) -> dict[str, float]:
    """Mean of a metric by subject; subjects with missing values are left out."""
    rows = whole_images(run.rows, label, metric, task)
    bad = set(rows[rows["status"] != "ok"]["subject"])
    return subject_means(rows[~rows["subject"].isin(bad)])


def curve_of(points: Sequence[RatePoint], method: str, metric: str, subject: str) -> Curve:
    """Megabytes and quality of a method's coded avatars of one subject, by increasing size."""
    coded = [p for p in points if p.method == method and p.variant and subject in p.megabytes]
    return sorted(
        (p.megabytes[subject], p.quality[metric][subject]) for p in coded if subject in p.quality[metric]
    )


def rate_difference(reference: Curve, other: Curve, *, higher_is_better: bool = True) -> float | None:
    """Mean difference of ln(megabytes) at equal quality, over the common range of quality of both curves.

    Bjontegaard's difference of rates (G. Bjontegaard, "Calculation of average PSNR differences between RD-curves", ITU-T
    VCEG-M33, 2001) with piecewise cubic Hermite interpolation of the logarithm of the rate in place of one cubic, as in
    ITU-T HSTP-VID-WPOM (2020), section 4.2. exp(result) - 1 is the BD-rate. Points dominated by others of the same curve
    are left out, so that quality increases with the rate.

    None with fewer than `LEAST_POINTS` points on a curve, and for curves without a common range of quality.
    """
    rates = []
    for curve in (reference, other):
        sizes = [size for size, _ in curve]
        qualities = [quality if higher_is_better else -quality for _, quality in curve]
        front = pareto_front(sizes, qualities)
        kept = {qualities[i]: math.log(sizes[i]) for i in front}
        if len(kept) < LEAST_POINTS:
            return None
        rates.append((np.array([*kept]), np.array([*kept.values()])))
    low = max(float(quality[0]) for quality, _ in rates)
    high = min(float(quality[-1]) for quality, _ in rates)
    if not low < high:
        return None
    from scipy.interpolate import PchipInterpolator

    one, two = (float(PchipInterpolator(*rate).integrate(low, high)) for rate in rates)
    return (two - one) / (high - low)


def rate_differences(
    points: Sequence[RatePoint], metrics: Sequence[MetricSpec], reference: str
) -> list[RateDifference]:
    """The difference of every method to the reference in every metric: mean over subjects, with an interval."""
    methods = [name for name in dict.fromkeys(point.method for point in points) if name != reference]
    subjects = sorted({subject for point in points for subject in point.megabytes})
    differences = []
    for metric, method in product(metrics, methods):
        values = []
        for subject in subjects:
            curves = (curve_of(points, name, metric.name, subject) for name in (reference, method))
            values.append(rate_difference(*curves, higher_is_better=metric.higher_is_better))
        differences.append(_difference(method, reference, metric.name, values))
    return differences


def _difference(method: str, reference: str, metric: str, values: Sequence[float | None]) -> RateDifference:
    logarithms = [value for value in values if value is not None]
    if len(logarithms) < len(values) or not values:
        reason = (
            f"{len(values) - len(logarithms)} of {len(values)} subjects have fewer than {LEAST_POINTS} steps of increasing quality, or curves "
            "without a common range of quality"
        )
        return RateDifference(method, reference, metric, None, reason=reason)
    mean, half = fmean(logarithms), half_width(logarithms) if len(logarithms) >= LEAST_SUBJECTS else None
    low, high = (None, None) if half is None else (_percent(mean - half), _percent(mean + half))
    return RateDifference(method, reference, metric, _percent(mean), low, high, len(logarithms))


def _percent(logarithm: float) -> float:
    return 100 * math.expm1(logarithm)


@dataclass(frozen=True)
class ParetoSettings:
    """Quality against size and frame time, over finished runs of the same frames; CSV, and a plot with the front."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs: every method in each is a point, such as the settings of a sweep. Runs of different subjects
    with the same methods and settings are joined; several trainings of a subject have a curve of rates each."""
    out: str
    """Folder to write: points.csv and pareto.png; with coded avatars also rates.csv and rate_distortion.png."""
    task: str = "novel_view"
    """Task whose frames give the quality."""
    metric: str = ""
    """Metric of quality; default: the first of frames that the runs have."""
    time: str = ""
    """Metric of frame time, in ms: latency_p50 (default, or 1 / frames per second), processor_time, ..."""
    reference: str = ""
    """Method that BD-rates compare with, if the runs have coded avatars at several steps; default: the first."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")


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
    coded avatars at several steps. Runs of different subjects are joined."""
    read = joined_subjects([RunData.read(Path(run)) for run in runs])
    points, left_out, metric, note = read_points(read, task, metric_name, time)
    check_output_folder(out)
    rising = metric.higher_is_better
    fronts = {cost: front_of(points, cost, higher_is_better=rising) for cost in COSTS}
    records = [asdict(point) for point in points]
    lines: list[list[object]] = [[*records[0], *(f"on_front_of_{cost}" for cost in COSTS)]]
    for index, record in enumerate(records):
        lines.append([*record.values(), *(int(index in fronts[cost]) for cost in COSTS)])
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
    data = {"out": out, "points": records, "fronts": fronts, "left_out": left_out, "note": note}
    data["rates"] = [asdict(rate) for rate in rates]
    text = _text(points, fronts, left_out, metric, note)
    names = ["points.csv", "pareto.png", *(("rates.csv", "rate_distortion.png") if rates else ())]
    written = ", ".join(str(out / name) for name in names)
    return CommandResult("\n".join([text, *map(_rate_text, rates), f"Written: {written}"]), data)


def _rates(
    points: Sequence[RatePoint], metrics: Sequence[MetricSpec], out: Path, task: str, reference: str
) -> list[RateDifference]:
    """Write the files of rate and distortion; return the differences to the reference, none with fewer than two steps."""
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
    metric: MetricSpec,
    note: str,
) -> str:
    rows = []
    for index, point in enumerate(points):
        values = {cost: getattr(point, cost) for cost in COSTS}
        costs = ["-" if value is None else f"{value:.2f}" for value in values.values()]
        costs = [text + " *" * (index in fronts[cost]) for cost, text in zip(COSTS, costs)]
        rows.append([point.method, f"{point.quality:.{metric.digits}f}", *costs, point.run])
    lines = [table(["method", metric.label, "MB", "ms", "run"], rows), "* On the front of size or time."]
    if any(point.derived_from for point in points):
        lines.append("METHOD+VARIANT was derived from the trained avatar, without training.")
    lines += [f"Frame times: {note}"] if note else []
    return "\n".join([*lines, *(f"left out: {text}" for text in left_out)])


MARKER = 7.0
"""Diameter of a point, in points of 1/72 inch."""
BESIDE = ((7, -8, "left"), (-7, 3, "right"), (7, 3, "left"), (-7, -8, "right"))
"""Positions of a label: offset of its lower edge from the point, in points, and its alignment."""


def write_plot(
    path: Path,
    points: Sequence[ParetoPoint],
    costs: Mapping[str, str],
    quality: str,
    *,
    higher_is_better: bool,
) -> None:
    """Draw quality over each cost (label by field of `ParetoPoint`) side by side and write a PNG, atomically.

    Costs are on a logarithmic axis. Steps connect the front of each series: its best quality up to a cost.
    Filled points are on the front of all series; squares are trained avatars.
    """
    shapes = ""
    if any(point.variant for point in points):
        shapes = " Squares: trained; circles: derived from them without training."
    machines = ", ".join(sorted({point.machine for point in points}))
    note = f"Lines: Pareto front of each method; filled: of all.{shapes} Measured on {machines}."
    size = (6.2 * len(costs), 4.9)
    names = [point.series for point in points]
    with plot_file(path, size, 200, names, note, line="") as (figure, looks):
        colours = {name: colour for name, (colour, _) in looks.items()}
        plots = list(zip(figure.subplots(1, len(costs), squeeze=False)[0], costs))
        fronts = {}
        for axes, cost in plots:
            axes.set(xlabel=costs[cost])
            start_axes(axes, quality)
            how = {"higher_is_better": higher_is_better}
            best, *others = (front_of(points, cost, series=s, **how) for s in (None, *colours))
            fronts[cost] = best, *others
            _draw(axes, points, cost, dict(zip(colours, others)), best, colours)
        figure.draw_without_rendering()  # compute the layout before placing labels
        for axes, cost in plots:
            label_points(axes, points, cost, list(itertools.chain(*fronts[cost])))


def write_rates(path: Path, points: Sequence[RatePoint], metrics: Sequence[MetricSpec], task: str) -> None:
    """Draw quality over megabytes for the steps of the codec: a curve for each method, a panel for each metric.

    Points are labelled with their step. Sizes are on a logarithmic axis; dashed lines are the quality of avatars as trained,
    whose size is not shown.
    """
    names = list(dict.fromkeys(point.method for point in points))
    subjects = {subject for point in points for subject in point.megabytes}
    note = (
        f"Lines: one codec at several steps, multiplied by the number beside a point; dashed: as trained. "
        f"Means over {counted(len(subjects), 'subject')}."
    )
    size = (6.2 * len(metrics), 4.9)
    with plot_file(path, size, 200, names, note, line="-", markers=MARKERS) as (figure, looks):
        panels = figure.subplots(1, len(metrics), squeeze=False)[0]
        for axes, metric in zip(panels, metrics):
            unit = f", {metric.unit}" if metric.unit else ""
            axes.set(xlabel="Size, MB")
            start_axes(axes, f"{metric.label}{unit}, {TASK_TITLES.get(task, task).lower()}")
            drawn = [_draw_rates(axes, points, metric.name, name, *look) for name, look in looks.items()]
            if any(drawn):
                cost_axis(axes)
            else:
                show_missing(axes, "not measured in these runs")


def _draw_rates(
    axes: Axes, points: Sequence[RatePoint], metric: str, name: str, colour: str, marker: str
) -> bool:
    """Draw the curve of one method; return whether there is one."""
    means = {point.variant: point.mean(metric) for point in points if point.method == name}
    trained = means.pop("", None)
    curve = sorted((*value, variant) for variant, value in means.items() if value is not None)
    if curve:
        axes.plot(*list(zip(*curve))[:2], f"{marker}-", color=colour, markersize=MARKER - 2, linewidth=1)
        for size, value, variant in curve:
            step = variant.partition("-x")[2] or "1"
            axes.annotate(
                step,
                (size, value),
                (3, 4),
                textcoords="offset points",
                fontsize=TEXT_POINTS - 2,
                color=colour,
            )
    if curve and trained is not None:
        axes.axhline(trained[1], color=colour, linewidth=0.8, linestyle="--")
    return bool(curve)


def _draw(
    axes: Axes,
    points: Sequence[ParetoPoint],
    cost: str,
    fronts: Mapping[str, Sequence[int]],
    best: Sequence[int],
    colours: Mapping[str, str],
) -> None:
    """Points, steps and axis of one panel."""
    if all(getattr(point, cost) is None for point in points):
        show_missing(axes, "not measured in these runs")
        return
    for name, front in fronts.items():
        corners = [(getattr(points[i], cost), points[i].quality) for i in front]
        axes.step(*zip(*corners), where="post", color=colours[name], linewidth=1) if corners else None
    for index, point in enumerate(points):
        if (x := getattr(point, cost)) is not None:
            colour, shape = colours[point.series], "o" if point.variant else "s"
            look: dict[str, Any] = {"color": colour, "markersize": MARKER, "zorder": 3}
            fill = colour if index in best else "white"
            axes.plot(x, point.quality, marker=shape, markerfacecolor=fill, **look)
    cost_axis(axes)


def label_points(axes: Axes, points: Sequence[ParetoPoint], cost: str, order: Sequence[int]) -> None:
    """Write the names of variants next to their points without overlaps, in the given order of indices."""
    scale = axes.get_figure(root=True).dpi / 72  # type: ignore[union-attr]
    costs = {i: getattr(point, cost) for i, point in enumerate(points)}
    places = {i: (value, points[i].quality) for i, value in costs.items() if value is not None}
    taken = [
        Bbox.from_bounds(x, y, 0, 0).padded(scale * MARKER / 2)
        for x, y in axes.transData.transform(list(places.values()) or [(1, 1)])
    ]
    for index in dict.fromkeys(order):
        variant = points[index].variant
        for right, up, align in BESIDE if variant else ():
            look: dict[str, Any] = {"ha": align, "fontsize": 7, "color": GREY, "in_layout": False}
            label = axes.annotate(variant, places[index], (right, up), textcoords="offset points", **look)
            box = label.get_window_extent()
            inside = axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1
            if inside and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            label.remove()
