"""A curve, read from the run of all its trainings: table, ``curve.csv``, ``curve.png``, and the best method at each cost."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import tyro

from ...bench.condition import Condition
from ...bench.contracts import Budget, FloatArray, FrameKey, Progress, no_progress
from ...bench.errors import InputError
from ...bench.experiments.held_out import tracking_error
from ...bench.experiments.specs import Over
from ...bench.io.files import write_text
from ...bench.manifest import ClipRecord, MethodRecord
from ...bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS
from ...bench.rows import ALL, FULL, Rows
from ...bench.specs import CommandResult, MetricSpec, command
from ...bench.terminal import table
from ..aggregate import QUALITY, subject_means
from ..drawing import MARKERS, TEXT_POINTS, cost_axis, plot_file, show_missing, start_axes
from ..runs import SPLIT_TASK, RunData, unseen_cameras
from ..statistics.comparisons import LEAST_SUBJECTS, half_width, interval
from ..writers import csv_text, pipe_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HELD_OUT: Mapping[str, str] = {
    "novel_view": "camera",
    "self_reenactment": "timesteps",
    SEEN_CAMERAS: "expressions_seen",
    UNSEEN_CAMERAS: "expressions_unseen",
}
"""Held-out data by task; the last two are test frames, see `_by_camera`."""
OF_FACE = "_face"
"""Suffix of a metric over the face."""
FACE = "face"
GAIN = 0.05
"""dB that twice the length of a training must gain at training cameras, or its curve has ended."""
MEASURED: Mapping[str, tuple[str, float]] = {
    "processor_seconds": ("training_processor", 1.0),
    "seconds": ("training_time", 60.0),
    "peak_memory_bytes": ("training_memory", 1e9),
}
"""Metric of each cost of a training, and its factor."""


@dataclass(frozen=True)
class CurvePoint:
    """A method trained with a part of its budget or of the frames, or with a level of tracking error.

    Values are means over seeds of one subject, or over subjects (""); None: not measured.
    """

    method: str
    subject: str
    place: tuple[float, ...]  # orders and identifies the points of a method
    part: Fraction
    budget: Budget
    cameras: float  # number in the training data, likewise the next two
    timesteps: float
    pictures: float
    tracking_error: float | None  # level of a synthetic capture, None for a recording
    cost: Mapping[str, float | None]  # of `MEASURED`, by name
    values: Mapping[str, float | None]  # by metric and held-out data, such as "psnr_camera"
    halves: Mapping[str, float | None]  # half the 95 % interval over subjects; None below `LEAST_SUBJECTS`

    def flat(self) -> dict[str, object]:
        """The point as a line of ``curve.csv``, by column."""
        budget = asdict(self.budget)
        counted = {
            name: getattr(self, name) for name in ("cameras", "timesteps", "pictures", "tracking_error")
        }
        return {
            "method": self.method,
            "subject": self.subject,
            "fraction": float(self.part),
            **{f"budget_{name}": budget[name] for name in ("iterations", "seconds")},
            **counted,
            **self.cost,
            **self.values,
        }


def mean(values: Sequence[float | None]) -> float | None:
    """Mean of numbers; None if any is missing or there are none."""
    present = [value for value in values if value is not None]
    return fmean(present) if present and len(present) == len(values) else None


def _half_width(values: Sequence[float | None]) -> float | None:
    """Half the width of the interval of a mean; None for fewer than `LEAST_SUBJECTS` numbers or a missing one."""
    present = [value for value in values if value is not None]
    return half_width(present) if LEAST_SUBJECTS <= len(present) == len(values) else None


def mean_point(points: Sequence[CurvePoint]) -> CurvePoint:
    """The mean over subjects of points that are otherwise equal."""
    first = points[0]
    by_name = {key: [point.values[key] for point in points] for key in first.values}
    names = ("cameras", "timesteps", "pictures")
    counts: dict[str, Any] = {name: fmean(getattr(point, name) for point in points) for name in names}
    return replace(
        first,
        **counts,
        subject="",
        cost={key: mean([point.cost[key] for point in points]) for key in first.cost},
        values={key: mean(values) for key, values in by_name.items()},
        halves={key: _half_width(values) for key, values in by_name.items()},
    )


def held_out(task: str) -> str:
    """Held-out data of a task in words."""
    return HELD_OUT[task].replace("_", ", ")


def column(spec: MetricSpec, task: str) -> str:
    """Name of a metric's value in `CurvePoint.values`."""
    return f"{spec.name}_{HELD_OUT[task]}" if task in HELD_OUT else spec.name


def points_text(curve: CurveData, failed: Sequence[str]) -> str:
    """Means over subjects as a table, with the held-out data and the missing values."""
    frame, costs = curve.of_frames, {name for name, _ in MEASURED.values()}
    avatar = [spec for spec in curve.metrics if not spec.per_frame and spec.name not in costs]
    tracked = any(point.tracking_error is not None for point in curve.means)
    place = ["method", "part", "budget"]
    heads = [*place, "cameras", "timesteps", "pictures", *["tracking"] * tracked, "CPU s", "s"]
    heads += [f"{spec.label} {spec.unit}".rstrip() for spec in avatar]
    trainings: list[list[str]] = []
    quality: dict[str, list[list[str]]] = {task: [] for task in curve.tasks if frame}
    for point in curve.means:
        budget = point.budget
        size = f"{budget.seconds:g} s" if budget.iterations is None else f"{budget.iterations}"
        where = [point.method, str(point.part), size]
        cells = [f"{count:g}" for count in (point.cameras, point.timesteps, point.pictures)]
        cells += [_text(point.tracking_error, 2)] * tracked
        cells += [_text(point.cost[key], 1) for key in ("processor_seconds", "seconds")]
        cells += [_text(point.values[spec.name], spec.digits) for spec in avatar]
        trainings.append([*where, *cells])
        for task, rows in quality.items():
            rows.append([*where, *(_text(point.values[column(spec, task)], spec.digits) for spec in frame)])
    lines = [table(heads, trainings, names=3, title="Trainings"), ""]
    for task, rows in quality.items():
        title = f"Quality, held-out {held_out(task)}"
        lines += [table([*place, *(spec.label for spec in frame)], rows, names=3, title=title), ""]
    lines.append(f"Means over subjects. {curve.frames}")
    trained = Counter((p.method, str(p.part), p.place) for p in curve.points if p.subject in curve.subjects)
    for (method, part, _), count in trained.items():
        if count < len(curve.subjects):
            lines.append(f"left out: {method} {part}, trained on {count} of {len(curve.subjects)} subjects")
    for subject in curve.subjects if not curve.of_test else ():
        parameters = curve.held_out[subject]
        timesteps = parameters["timesteps"]
        steps = ", ".join([*map(str, timesteps[:6]), *(["..."] if len(timesteps) > 6 else [])])
        lines.append(f"  {subject}: camera {parameters['camera'] or 'none'}, timesteps {steps or 'none'}")
    lines += [f"{label} missing: {reason}" for label, reason in curve.missing.items()]
    return "\n".join([*lines, *(f"failed: {name}" for name in failed)])


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


@dataclass(frozen=True)
class CurveReportSettings:
    """Runs of `headbench run curve` as one curve: of several subjects, or of several methods of a subject.

    Prints the means over subjects and the best method for each cost of a training, with 95 % intervals of the crossings of two methods."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders that `headbench run curve` wrote."""
    out: str
    """Folder to write: curve.csv and curve.png."""
    over: Over = "budget"
    """What the trainings differ in, as for `headbench run curve`."""
    methods: tuple[str, ...] = ()
    """Only these methods, for example two, to see where their curves cross; default: all."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")


Lines: TypeAlias = Mapping[str, Mapping[str, Sequence[tuple[float, float]]]]
"""Pairs of cost and quality by method and subject."""
GRID = 600
"""Costs at which curves are compared, evenly spaced on the axis of the plot."""


@dataclass(frozen=True)
class Leader:
    """A method that has the best mean from a certain cost on.

    ``interval`` are the costs around ``start`` at which the 95 % interval of the paired difference to the previous leader
    contains 0; an end beyond the compared costs is None. None instead of a pair for the first leader, and with too few subjects.
    """

    method: str
    start: float  # where its curve crosses that of the previous leader, or the lowest compared cost
    interval: tuple[float | None, float | None] | None
    compared: tuple[float, float]  # lowest and highest compared cost

    def text(self) -> str:
        """Method, cost and interval, such as "`ga` from 11 [8.2, above 120]"."""
        if self.interval is None:
            return f"`{self.method}` from {self.start:.3g}"
        low, high = (f"{end:.3g}" if end is not None else "" for end in self.interval)
        ends = f"{low or f'below {self.compared[0]:.3g}'}, {high or f'above {self.compared[1]:.3g}'}"
        return f"`{self.method}` from {self.start:.3g} [{ends}]"


def leaders(lines: Lines, *, higher_is_better: bool) -> list[Leader]:
    """The methods with the best mean, by increasing cost, over the subjects that all methods have.

    Quality is interpolated linearly between measured trainings, over the logarithm of the cost if all costs are above 0. Methods are
    compared from the lowest cost on at which all have a training. Beyond its highest cost a method keeps the quality there, since
    that training also fits larger budgets.
    """
    subjects = sorted(set.intersection(*(set(own) for own in lines.values()))) if lines else []
    if not subjects:
        return []
    pairs = {
        name: [np.array(sorted(line[subject])).T for subject in subjects] for name, line in lines.items()
    }
    first, last = ([float(cost[end]) for own in pairs.values() for cost, _ in own] for end in (0, -1))
    lowest, highest = max(first), max(last)
    scale, spaced = (np.log, np.geomspace) if min(first) > 0 else (np.positive, np.linspace)
    grid = spaced(lowest, highest, GRID)
    sign = 1.0 if higher_is_better else -1.0
    values = {}  # by method, (S, G) qualities of the subjects at the costs of the grid
    for name, own in pairs.items():
        values[name] = sign * np.stack(
            [np.interp(scale(grid), scale(cost), quality) for cost, quality in own]
        )
    names = list(values)
    best = np.stack([curves.mean(0) for curves in values.values()]).argmax(0)
    leading: list[Leader] = []
    for place, name in enumerate(names[number] for number in best):
        if leading and leading[-1].method == name:
            continue
        around = _around(values[name] - values[leading[-1].method], place, grid) if leading else None
        leading.append(Leader(name, float(grid[place]), around, (lowest, highest)))
    return leading


def _around(change: FloatArray, place: int, grid: FloatArray) -> tuple[float | None, float | None] | None:
    """Costs between which the interval of the mean ``change``, (S, G), contains 0, around a place of the grid."""
    bounds = [interval(changes.tolist()) for changes in change.T]
    if bounds[place] is None:
        return None
    different = [ends is not None and (ends[0] > 0 or ends[1] < 0) for ends in bounds]
    low = next((float(grid[i]) for i in range(place - 1, -1, -1) if different[i]), None)
    high = next((float(grid[i]) for i in range(place, len(grid)) if different[i]), None)
    return low, high


@dataclass(frozen=True)
class CurvePanel:
    """One plot: (cost, quality, half the interval's width) of each method; ``reason`` if empty."""

    title: str
    lines: Mapping[str, Sequence[tuple[float, float, float]]]
    reason: str


def write_plot(path: Path, rows: Sequence[Sequence[CurvePanel]], cost: str, note: str) -> None:
    """Draw rows of panels of equal number and write a PNG, atomically; costs on a logarithmic axis if all are above 0."""
    names = (name for row in rows for panel in row for name in panel.lines)
    size = (4.2 * len(rows[0]), 3.2 * len(rows) + 0.8)
    with plot_file(path, size, 150, names, note, line="-", markers=MARKERS) as (figure, looks):
        grid = figure.subplots(len(rows), len(rows[0]), squeeze=False)
        for axes, panel in zip(grid.ravel(), itertools.chain(*rows)):
            _draw(axes, panel, cost, looks)


def _draw(axes: Axes, panel: CurvePanel, cost: str, looks: Mapping[str, tuple[str, str]]) -> None:
    start_axes(axes, panel.title)
    axes.set_xlabel(cost, fontsize=TEXT_POINTS)
    if not any(panel.lines.values()):
        show_missing(axes, textwrap.fill(f"missing: {panel.reason or 'the trainings failed'}", 44))
        return
    for name, points in panel.lines.items():
        if points:
            costs, values, halves = zip(*points)
            bars = halves if any(halves) else None
            colour, marker = looks[name]
            line = axes.errorbar(costs, values, bars, color=colour, linewidth=1.2, capsize=2)
            line.lines[0].set(marker=marker, markersize=4)
    each = [paid for line in panel.lines.values() for paid, _, _ in line]
    cost_axis(axes, logarithmic=min(each) > 0, whole=all(paid == round(paid) for paid in each))


TIMED = ("budget", "seconds")
"""Quantities whose axis in the plot is the measured training time."""
LIMIT = "limit of training time"
OVERRUN = 1.05
"""A training with a limit of seconds counts as that limit if it took at most this many times as long, since the last
iteration and writing the avatar come after the limit."""
AXES = {
    "cameras": "Training cameras",
    "timesteps": "Training timesteps",
    "pictures": "Training pictures",
    "tracking_error": "Level of tracking error",
}


def curve_report(parts: Sequence[Path], over: str, out: Path) -> CommandResult:
    """Write ``curve.csv`` and ``curve.png`` of runs of one curve; see `joined_curve`."""
    return joined_curve([RunData.read(part) for part in parts], over, out)


@command("report curve", group="inspect", writes="out")
def curve_runs(settings: CurveReportSettings, progress: Progress = no_progress) -> CommandResult:
    """Join runs of `headbench run curve`: means over subjects, and the best method for each cost of a
    training."""
    runs = [RunData.read(path) for run in settings.runs for path in _parts(Path(run))]
    return joined_curve(runs, settings.over, Path(settings.out), settings.methods)


def _parts(curve: Path) -> list[Path]:
    """The runs of a curve: its folder, or those in the folder of one with ``--until-flat``."""
    inside = sorted(file.parent for file in curve.glob("*/run.json"))
    return [curve] if (curve / "run.json").is_file() or not inside else inside


def rising(parts: Sequence[Path], over: str) -> set[str]:
    """Methods whose curve has not ended at its last training, see `ended`."""
    curve = read_curve([RunData.read(part) for part in parts], over)
    psnr = next(name for name in ("psnr_face", "psnr") if any(spec.name == name for spec in curve.metrics))
    seen = HELD_OUT[next(task for task in curve.tasks if task != "novel_view")]
    return {
        name for name, own in curve.by_method.items() if not ended(own, f"{psnr}_{seen}", f"{psnr}_camera")
    }


def ended(points: Sequence[CurvePoint], seen: str, unseen: str) -> bool:
    """Whether the last of a method's points, by length, gains less than `GAIN` for twice the length, or is worse at the other
    cameras."""
    if len(points) < 2:
        return False
    before, last = points[-2:]
    values = [(point.values[seen], point.values.get(unseen)) for point in (before, last)]
    (seen_before, unseen_before), (seen_last, unseen_last) = values
    if seen_before is None or seen_last is None:
        return True  # a training failed
    lengths = [point.budget.iterations or point.budget.seconds or 1.0 for point in (before, last)]
    gain = (seen_last - seen_before) / math.log2(lengths[1] / lengths[0])
    return gain < GAIN or (
        unseen_before is not None and unseen_last is not None and unseen_last < unseen_before
    )


def joined_curve(runs: Sequence[RunData], over: str, out: Path, methods: Sequence[str] = ()) -> CommandResult:
    """Write ``curve.csv`` and ``curve.png`` of runs; return points, a table of their means, and the best method by cost."""
    curve = read_curve(runs, over, methods)
    out.mkdir(parents=True, exist_ok=True)
    records = [point.flat() for point in curve.points]
    write_text(out / "curve.csv", csv_text([[*records[0]], *([*record.values()] for record in records)]))
    write_curve(out / "curve.png", curve)
    failed = [name for run in runs for name in run.rows.failed]
    data = {
        "out": out,
        "held_out": curve.held_out,
        "points": records,
        "best": [
            {"metric": metric, "held_out": HELD_OUT[task], **asdict(leader)}
            for (metric, task), leading in curve.best.items()
            for leader in leading
        ],
        "missing": curve.missing,
        "failed": failed,
    }
    written = f"Written: {out / 'curve.csv'}, {out / 'curve.png'}"
    text = "\n\n".join([points_text(curve, failed), leaders_text(curve, markdown=False), written])
    return CommandResult(text, data, not failed)


@dataclass(frozen=True)
class CurveData:
    """Trainings that differ in one quantity."""

    over: str
    subjects: Sequence[str]  # that all methods have, over which the means are taken
    points: Sequence[CurvePoint]  # all trainings, by method, quantity and subject
    means: Sequence[CurvePoint]  # over subjects
    metrics: Sequence[MetricSpec]
    tasks: Sequence[str]
    clock: str  # the cost in `MEASURED` that measures training time on the device
    best: Mapping[tuple[str, str], Sequence[Leader]]  # by name of a frame metric and task
    every: int  # one of this many consecutive training timesteps is held out; 0 if test frames were scored
    held_out: Mapping[str, Mapping[str, Any]]  # camera and timesteps, and remaining training data, by subject
    missing: Mapping[str, str]  # reasons by label of a metric that was not measured

    @property
    def by_method(self) -> dict[str, list[CurvePoint]]:
        """The means of each method, by increasing quantity."""
        points: dict[str, list[CurvePoint]] = {}
        for point in self.means:
            points.setdefault(point.method, []).append(point)
        return points

    @property
    def of_test(self) -> bool:
        """Whether the test frames of the captures were scored."""
        return not self.every

    @property
    def frames(self) -> str:
        """What was scored, in words."""
        if self.of_test:
            return "Test frames of the captures."
        return "Held out of every training; no test frame was used:"

    @property
    def of_frames(self) -> list[MetricSpec]:
        """The frame metrics."""
        return [spec for spec in self.metrics if spec.per_frame]

    @property
    def axis(self) -> str:
        """Name of the varied quantity, as measured."""
        measured = f"{'Processor seconds' if self.clock == 'processor_seconds' else 'Seconds'} of training"
        return measured if self.over in TIMED else AXES[self.over]


def read_curve(runs: Sequence[RunData], over: str, methods: Sequence[str] = ()) -> CurveData:
    """Read the trainings of runs of the same kind of curve, which differ in the quantity ``over``; of some methods if named."""
    runs = [_by_camera(run) for run in runs]
    points = [point for run in runs for point in _points(run, over)]
    for name in methods:
        if name not in (known := list(dict.fromkeys(point.method for point in points))):
            raise InputError("command line", "--methods", f"methods of the runs: {', '.join(known)}", name)
    points = [point for point in points if not methods or point.method in methods]
    _check_together(runs, points)
    tasks, metrics = runs[0].tasks, _metrics(runs[0])
    names = list(dict.fromkeys(point.method for point in points))
    order = list(dict.fromkeys(point.subject for point in points))
    trained = {(point.method, point.subject) for point in points}
    shared = [subject for subject in order if all((name, subject) in trained for name in names)]
    if not shared:
        expected = "a subject that all methods were trained on"
        raise InputError(runs[0].folder.manifest, "subjects", expected, "none in these runs")
    points.sort(key=lambda p: (names.index(p.method), p.place, order.index(p.subject)))
    groups: dict[tuple[str, tuple[float, ...]], list[CurvePoint]] = {}
    for point in (point for point in points if point.subject in shared):
        groups.setdefault((point.method, point.place), []).append(point)
    clock = "processor_seconds" if runs[0].manifest.configuration.device == "cpu" else "seconds"
    return CurveData(
        over,
        shared,
        points,
        [mean_point(group) for group in groups.values() if len(group) == len(shared)],
        metrics,
        tasks,
        clock,
        _leaders(points, metrics, tasks, {"budget": clock, "seconds": LIMIT}.get(over, over)),
        0 if _of_test(runs[0]) else runs[0].manifest.configuration.clip.parameters["every"],
        {clip.subject: _step(clip.steps, "hold_out") for run in runs for clip in run.manifest.clips},
        {
            spec.label: reason
            for run in runs
            for spec in run.manifest.metrics
            if spec.per_frame and (reason := _reason(run.rows, spec))
        },
    )


def write_curve(path: Path, curve: CurveData) -> None:
    """Draw the means as a PNG: a row of plots for each task, a plot for each frame metric."""
    axis = curve.clock if curve.over in TIMED else curve.over
    rows = [[_panel(curve, spec, task, axis) for spec in curve.of_frames] for task in curve.tasks]
    left_out = {
        "novel_view": "a training camera",
        "self_reenactment": f"one of {curve.every} consecutive training timesteps",
    }
    note = curve.frames
    if not curve.of_test:
        held = " and ".join(left_out[task] for task in curve.tasks)
        note = f"Held out of every training: {held}. No test frame was used."
    count = len(curve.subjects)
    if count >= LEAST_SUBJECTS:
        note += f" Bars: 95 % intervals of the mean over {count} subjects."
    elif count > 1:
        note += f" Means over {count} subjects, which are too few for intervals."
    write_plot(path, rows, curve.axis, note)


def _of_test(run: RunData) -> bool:
    """Whether a curve was measured on the test frames of its captures."""
    return bool(run.manifest.configuration.clip.parameters.get("test"))


def _by_camera(run: RunData) -> RunData:
    """The run with self-reenactment of test frames split by whether their cameras have training frames, if both exist."""
    unseen, _ = unseen_cameras([run.manifest], run.keys(SPLIT_TASK))
    if not _of_test(run) or not unseen:
        return run
    protocols = dict(run.manifest.protocols)
    whole = protocols.pop(SPLIT_TASK)
    for task, chosen in ((SEEN_CAMERAS, False), (UNSEEN_CAMERAS, True)):
        keys = tuple(key for key in whole.keys if ((key.subject, key.camera) in unseen) == chosen)
        protocols[task] = replace(whole, keys=keys)
    rows = run.rows.split_by_camera(SPLIT_TASK, unseen, UNSEEN_CAMERAS, SEEN_CAMERAS)
    return replace(run, manifest=replace(run.manifest, protocols=protocols), rows=rows)


def _metrics(run: RunData) -> tuple[MetricSpec, ...]:
    """The run's metrics, and PSNR of the face if it was measured."""
    of_face = run.rows.of_part(FACE, (), FULL).metrics if FACE in run.rows.regions else set()
    specs = []
    for spec in run.manifest.metrics:
        specs.append(spec)
        if spec.name == QUALITY and spec.name in of_face:
            specs.append(replace(spec, name=spec.name + OF_FACE, label=f"{spec.label} of the face"))
    return tuple(specs)


def _points(run: RunData, over: str) -> list[CurvePoint]:
    """The trainings of a run that differ in ``over``. Raises `InputError` where there are none."""
    config = run.manifest.configuration
    conditions = {condition.name: condition for condition in config.conditions}
    quantities = {}
    for name, condition in conditions.items() if "every" in config.clip.parameters else ():
        of_budget = "seconds" if condition.budget.endswith(" s") else "budget"
        quantities[name] = condition.clip.name.replace("-", "_") or of_budget
    points = [
        _point(run, record, conditions[record.condition], clip)
        for record in run.manifest.methods
        for clip in run.manifest.clips
        if quantities.get(record.condition) == over
    ]
    if not points:
        expected = f"trainings of `headbench run curve --over {over}`"
        others = sorted({quantities[m.condition] for m in run.manifest.methods if m.condition in quantities})
        instead = f"trainings of --over {' and '.join(others)}" if others else "none"
        raise InputError(run.folder.manifest, "configuration", expected, instead)
    return points


def _check_together(runs: Sequence[RunData], points: Sequence[CurvePoint]) -> None:
    """Raise `InputError` for runs whose trainings cannot be compared."""
    first = runs[0].manifest
    frames: dict[tuple[str, str], set[FrameKey]] = {}
    versions: dict[str, str] = {}
    trainings: dict[str, MethodRecord] = {}
    for run in runs:
        place, other = run.folder.manifest, run.manifest
        for name in ("device", "preset", "divide", "seeds"):
            expected, value = (str(getattr(m.configuration, name)) for m in (first, other))
            if value != expected:
                raise InputError(place, name, expected, value)
        if other.metrics != first.metrics:
            raise InputError(place, "metrics", f"those of {runs[0].folder.root}", "others")
        expected, value = (str(m.configuration.clip.parameters["every"]) for m in (first, other))
        if value != expected:
            raise InputError(place, "every", expected, value)
        for record in other.methods:
            version = versions.setdefault(record.name, record.version)
            if record.version != version:
                raise InputError(place, f"version of {record.name}", version, record.version)
            same = trainings.setdefault(record.label, record)
            for name in ("budget", "config"):
                expected, value = (str(getattr(each, name)) for each in (same, record))
                if value != expected:
                    raise InputError(place, f"{name} of {record.label}", expected, value)
        if run.tasks != runs[0].tasks:
            raise InputError(place, "tasks", ", ".join(runs[0].tasks), ", ".join(run.tasks))
        for task, subject in product(run.tasks, run.rows.subjects):
            keys = {key for key in run.keys(task) if key.subject == subject}
            if keys != frames.setdefault((task, subject), keys):
                expected = f"the held-out frames of {subject} in the other runs"
                raise InputError(place, f"protocol of {task}", expected, "others")
    trained = Counter((point.method, point.subject, point.place) for point in points)
    (method, subject, _), count = trained.most_common(1)[0]
    if count > 1:
        expected = f"each training of {method} on {subject} once"
        raise InputError(runs[-1].folder.manifest, "methods", expected, f"one of them {count} times")


def _cost(point: CurvePoint, axis: str) -> float | None:
    """Cost of a training: a measured cost, its `LIMIT` of seconds (or its seconds, beyond `OVERRUN`), or a field of the point."""
    if axis == LIMIT:
        limit, seconds = point.budget.seconds, point.cost["seconds"]
        return seconds if limit and seconds and seconds > OVERRUN * limit else limit
    return point.cost[axis] if axis in point.cost else getattr(point, axis)


def _leaders(
    points: Sequence[CurvePoint], metrics: Sequence[MetricSpec], tasks: Sequence[str], axis: str
) -> dict[tuple[str, str], list[Leader]]:
    """`leaders` by name of a frame metric and task; methods with a failed training are excluded."""
    by_column = {}
    for spec, task in product((spec for spec in metrics if spec.per_frame), tasks):
        lines: dict[str, dict[str, list[tuple[float, float]]]] = {}
        # A line must not skip a failed training.
        failed = {point.method for point in points if point.values[column(spec, task)] is None}
        for point in (point for point in points if point.method not in failed):
            cost, value = _cost(point, axis), point.values[column(spec, task)]
            if cost is not None and value is not None:
                lines.setdefault(point.method, {}).setdefault(point.subject, []).append((cost, value))
        by_column[spec.name, task] = leaders(lines, higher_is_better=spec.higher_is_better)
    return by_column


def leaders_text(curve: CurveData, *, markdown: bool = True) -> str:
    """The best methods by metric and held-out data, in a sentence and a table: Markdown, or for a terminal."""
    heads = [f"held-out {held_out(task)}" for task in curve.tasks]
    lines = []
    for spec in curve.of_frames:
        cells = ("; ".join(leader.text() for leader in curve.best[spec.name, task]) for task in curve.tasks)
        lines.append([spec.label, *(cell or "–" for cell in cells)])
    rule = ["---"] * (1 + len(heads))
    shown = pipe_table([["", *heads], rule, *lines]) if markdown else table(["metric", *heads], lines)
    taken = "limit of seconds" if curve.over == "seconds" else curve.axis.lower()
    crossings = "in brackets, the costs around it at which the 95 % interval of the difference contains 0"
    if len(curve.subjects) < LEAST_SUBJECTS:
        crossings = f"without intervals, which need {LEAST_SUBJECTS} subjects"
    return (
        f"Methods with the best mean, each with the {taken} from which it leads (interpolated between trainings, {crossings}):"
        f"\n\n{shown}"
    )


def _point(run: RunData, record: MethodRecord, condition: Condition, clip: ClipRecord) -> CurvePoint:
    values: dict[str, float | None] = {}
    for spec in _metrics(run):
        name, region = spec.name.removesuffix(OF_FACE), FACE if spec.name.endswith(OF_FACE) else FULL
        for task in run.tasks if spec.per_frame else ("",):
            chosen = run.rows.select(
                method=record.label, metric=name, task=task, region=region, seeds=ALL, subject=clip.subject
            )
            whole = len(chosen) and (chosen["status"] == "ok").all()
            values[column(spec, task)] = subject_means(chosen)[clip.subject] if whole else None
    measured = {key: (values.pop(metric, None), factor) for key, (metric, factor) in MEASURED.items()}
    cost = {key: None if value is None else factor * value for key, (value, factor) in measured.items()}
    adapted = (a for a in run.manifest.adapted if (a.subject, a.method) == (clip.subject, record.label))
    reduced = _step(next((a.steps for a in adapted), []), "reduce_training")
    training = {**_step(clip.steps, "hold_out")["training"], **reduced}
    part = condition.part if condition.part != 1 else Fraction(condition.clip.parameters.get("part", "1"))
    budget, level = Budget(**record.budget), condition.clip.parameters.get("level")
    place = float(part), budget.seconds or 0.0, float(condition.clip.parameters.get("count", 0)), level or 0.0
    return CurvePoint(
        *(record.name, clip.subject, place, part, budget),
        cameras=len(training["cameras"]),
        timesteps=len(training["timesteps"]),
        pictures=training.get("count", clip.splits["train"]),
        tracking_error=tracking_error(clip.steps) if level is None else level,
        cost=cost,
        values=values,
        halves={},
    )


def _step(steps: Sequence[Mapping[str, Any]], name: str) -> Mapping[str, Any]:
    """Parameters of a processing step, empty if it was not applied."""
    return next((step["parameters"] for step in steps if step["name"] == name), {})


def _reason(rows: Rows, spec: MetricSpec) -> str:
    """Reason why a metric was not measured; "" if it was, or if trainings failed."""
    values = rows.select(method=ALL, metric=spec.name, task=ALL, region=FULL, seeds=ALL)
    reasons = values.loc[values["status"] == "missing", "reason"]
    return " ".join(str(reasons.iloc[0]).split()) if len(reasons) else ""


def _panel(curve: CurveData, spec: MetricSpec, task: str, axis: str) -> CurvePanel:
    """Quality over the horizontal axis: a field of `CurvePoint` or a cost."""
    lines: dict[str, list[tuple[float, float, float]]] = {}
    for point in curve.means:
        cost = _cost(point, axis)
        value, half = point.values[column(spec, task)], point.halves[column(spec, task)]
        line = lines.setdefault(point.method, [])
        if cost is not None and value is not None:
            cost = max(cost, 1e-3) if axis in point.cost else cost  # times are recorded in whole milliseconds
            line.append((cost, value, half or 0.0))
    unit = f", {spec.unit}" if spec.unit else ""
    title = f"{spec.label}{unit}, held-out {held_out(task)}"
    return CurvePanel(title, lines, curve.missing.get(spec.label, ""))
