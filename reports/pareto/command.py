"""``headbench report pareto``."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_output_folder, write_text
from ...bench.rows import FULL
from ...bench.specs import CommandResult, MetricSpec, command
from ...bench.terminal import table
from ..aggregate import LATENCY, SPEED, STORAGE, Conditions, conditions, note_of, pareto_front, summarise
from ..drawing import GREY, cost_axis, plot_file, show_missing, start_axes
from ..runs import RunData, check_same_protocol, joined_subjects
from ..writers import csv_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
                for name, where in ((metric, task), (STORAGE, ""), (SPEED, ""), (time or LATENCY, ""))
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
class ParetoSettings:
    """Quality against size and frame time, over finished runs of the same frames; CSV, and a plot with the front."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs: every method in each is a point, such as the settings of a sweep. Runs of different subjects
    with the same methods and settings are joined."""
    out: str
    """Folder to write: points.csv and pareto.png."""
    task: str = "novel_view"
    """Task whose frames give the quality."""
    metric: str = ""
    """Metric of quality; default: the first of frames that the runs have."""
    time: str = ""
    """Metric of frame time, in ms: latency_p50 (default, or 1 / frames per second), processor_time, ..."""
    region: str = "full"
    """Region of the frames that gives the quality, such as face."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")


COSTS = {"megabytes": "Size, MB", "milliseconds": "Frame time, ms"}


def _of_region(data: RunData, region: str) -> RunData:
    """A run with the values of a region instead of whole frames."""
    if region not in data.rows.regions:
        known = ", ".join(sorted(data.rows.regions))
        raise InputError(data.folder.rows, "region", f"one of {known}", region)
    return replace(data, rows=data.rows.of_part(region, (), FULL))


@command("report pareto", group="inspect", writes="out")
def pareto_runs(settings: ParetoSettings, progress: Progress = no_progress) -> CommandResult:
    """Plot quality against size and frame time of runs, with the Pareto front."""
    chosen = settings.task, settings.metric, settings.time, settings.region
    return pareto(settings.runs, Path(settings.out), *chosen)


def pareto(
    runs: Sequence[str], out: Path, task: str, metric_name: str = "", time: str = "", region: str = FULL
) -> CommandResult:
    """Write ``points.csv`` and ``pareto.png`` of finished runs; those of different subjects are joined."""
    read = joined_subjects([RunData.read(Path(run)) for run in runs])
    if region != FULL:
        read = [_of_region(data, region) for data in read]
    points, left_out, metric, note = read_points(read, task, metric_name, time)
    if region != FULL:
        metric = replace(metric, label=f"{metric.label} of the {region}")
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
    data = {"out": out, "points": records, "fronts": fronts, "left_out": left_out, "note": note}
    written = f"Written: {out / 'points.csv'}, {out / 'pareto.png'}"
    return CommandResult(f"{_text(points, fronts, left_out, metric, note)}\n{written}", data)


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
    from matplotlib.transforms import Bbox

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
