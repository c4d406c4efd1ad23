"""``headbench report trackings``: errors due to the tracking and to the method, of runs on several trackings of the same frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from ..bench.condition import label_of
from ..bench.contracts import FloatArray, Progress, no_progress
from ..bench.errors import InputError
from ..bench.protocol import TASK_TITLES, evenly
from ..bench.rows import FULL
from ..bench.specs import CommandResult, MetricSpec, command
from ..bench.terminal import table
from .aggregate import summarise
from .runs import RunData
from .writers import csv_text

PICTURES, SAME = 4, 0.1
"""Pictures of a task that are compared between captures, and the largest mean difference of the same picture, levels of 255."""
REMEDY = (
    "Make all captures with the same masks and with --cut none, since the bust line depends on the tracking."
)


@dataclass(frozen=True)
class TrackingsSettings:
    """Separate the error due to the tracking from that due to the method: the same methods on several trackings of the same frames."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs, one for each tracking, with the same methods and settings. Conditions in a run, such as
    `tracked`, count as further trackings."""
    metrics: tuple[str, ...] = ("psnr", "lpips")
    """Metrics of frames."""
    regions: tuple[str, ...] = (FULL, "face")
    """Regions of the frames."""
    format: Literal["text", "csv"] = "text"
    """Format of the output."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs: at least one folder")


@dataclass(frozen=True)
class Effects:
    """Additive model of values: mean + effect of the method + effect of the tracking + remainder."""

    mean: float
    methods: FloatArray
    """(M,) mean of each method over the trackings, less the mean."""
    trackings: FloatArray
    """(T,) mean of each tracking over the methods, less the mean."""
    remainder: FloatArray
    """(M, T)."""
    shares: FloatArray
    """Fractions of the variance due to tracking, method and remainder; 0 if all values are equal."""

    @classmethod
    def of(cls, values: FloatArray) -> Effects:
        """Effects of the values (M, T)."""
        mean = float(values.mean())
        methods, trackings = values.mean(axis=1) - mean, values.mean(axis=0) - mean
        remainder = values - mean - methods[:, None] - trackings
        parts = np.array([(trackings**2).mean(), (methods**2).mean(), (remainder**2).mean()])
        return cls(mean, methods, trackings, remainder, parts / (parts.sum() or 1.0))


@dataclass(frozen=True)
class TrackingComparison:
    """Values of one metric in one region of a task."""

    task: str
    region: str
    metric: MetricSpec
    trackings: tuple[str, ...]
    methods: tuple[str, ...]
    values: FloatArray
    """(methods, trackings), NaN where missing."""
    chosen: tuple[int, ...]
    """Indices of the methods of the effects: trained, with a value on every tracking."""
    effects: Effects | None
    """None without such methods."""

    def text(self) -> str:
        """The table, and below it a sentence on the effects."""
        number, unit = f".{self.metric.digits}f", f" {self.metric.unit}".rstrip()
        spans = self.values.max(axis=1) - self.values.min(axis=1)
        lines = [
            [name, *(_text(value, number) for value in (*row, span)), ""]
            for name, row, span in zip(self.methods, self.values, spans)
        ]
        below = "No trained method has a value on every tracking."
        if effects := self.effects:
            for index, effect in zip(self.chosen, effects.methods):
                lines[index][-1] = f"{effect:+{number}}"
            means = effects.mean + effects.trackings
            lines.append(["mean", *(_text(value, number) for value in (*means, np.ptp(means))), ""])
            lines.append(
                ["due to tracking", *(f"{effect:+{number}}" for effect in effects.trackings), "", ""]
            )
            sizes = np.ptp(means), np.ptp(effects.methods), np.abs(effects.remainder).max()
            parts = [f"{size:{number}}{unit} ({share:.0%}" for size, share in zip(sizes, effects.shares)]
            below = f"Trackings differ by {parts[0]} of the variance), methods by {parts[1]}); remainder at most {parts[2]})."
        where = f"{TASK_TITLES.get(self.task, self.task)}, {'whole frames' if self.region == FULL else self.region}"
        head = ["Method", *self.trackings, "range", "due to method"]
        return f"{table(head, lines, title=f'{where}: {self.metric.label}{unit}')}\n{below}"


@command("report trackings", group="inspect")
def tracking_runs(settings: TrackingsSettings, progress: Progress = no_progress) -> CommandResult:
    """Tell the error due to the tracking from that due to the method, from runs on several trackings."""
    runs = [RunData.read(Path(folder)) for folder in settings.runs]
    for run in runs[1:]:
        _check_same(runs[0], run)
    found = comparisons(runs, settings.metrics, settings.regions)
    data = [asdict(each) for each in found]
    if settings.format == "csv":
        cells = [
            (each.task, each.region, each.metric.name, method, tracking, "" if np.isnan(value) else value)
            for each in found
            for method, row in zip(each.methods, each.values.tolist())
            for tracking, value in zip(each.trackings, row)
        ]
        text = csv_text([("task", "region", "metric", "method", "tracking", "value"), *cells])
        return CommandResult(text, data, verbatim=True)
    note = "Effects are of the trained methods. Regions are those of each capture's own tracking."
    return CommandResult("\n\n".join([*(each.text() for each in found), note]), data)


def comparisons(
    runs: Sequence[RunData], metrics: Sequence[str], regions: Sequence[str]
) -> list[TrackingComparison]:
    """One for each task, region and metric, of runs with the same frames and methods."""
    first, found = runs[0], []
    specs = {spec.name: spec for spec in first.manifest.metrics if spec.per_frame}
    for option, given, valid in (
        ("metrics", metrics, [*specs]),
        ("regions", regions, sorted(first.rows.regions)),
    ):
        if unknown := [name for name in given if name not in valid]:
            raise InputError("command line", f"--{option}", f"one of {', '.join(valid)}", unknown[0])
    folders = [run.folder.root.resolve() for run in runs]
    if twice := [folder for i, folder in enumerate(folders) if folder in folders[:i]]:
        raise InputError("command line", "runs", "each run once", f"{twice[0]} again", "Name another folder.")
    unique = len({folder.name for folder in folders}) == len(folders)
    names, columns = [], []
    for run, folder in zip(runs, folders):
        for condition in dict.fromkeys(record.condition for record in run.manifest.methods):
            names.append(label_of(folder.name if unique else str(folder), condition))
            columns.append((run.rows, condition))
    if len(names) < 2:
        raise InputError("command line", "runs", "two trackings: two runs, or one with conditions", names[0])
    trivial = {record.name: record.trivial for record in first.manifest.methods}
    methods = sorted(trivial, key=trivial.__getitem__)
    for region in regions:
        parts = [(rows.of_part(region, (), FULL), condition) for rows, condition in columns]
        for task, metric in product(first.tasks, metrics):
            values = np.array(
                [
                    [summarise(rows, label_of(method, name), metric, task).value for rows, name in parts]
                    for method in methods
                ],
                float,
            )
            present = np.isfinite(values).all(axis=1)
            chosen = tuple(i for i, method in enumerate(methods) if present[i] and not trivial[method])
            effects = Effects.of(values[[*chosen]]) if chosen else None
            found.append(
                TrackingComparison(
                    task, region, specs[metric], (*names,), (*methods,), values, chosen, effects
                )
            )
    return found


def _check_same(first: RunData, run: RunData) -> None:
    """Raise `InputError` unless two runs have the same methods, frames and pictures."""
    root, other = run.folder.root, f"those of {first.folder.root}"
    methods = [
        {record.name: (record.version, record.config, record.budget) for record in each.manifest.methods}
        for each in (first, run)
    ]
    if methods[0] != methods[1]:
        differ = [n for n in methods[0] | methods[1] if methods[0].get(n) != methods[1].get(n)]
        raise InputError(
            run.folder.manifest, "methods", f"{other}, with the same settings", f"another {differ[0]}"
        )
    if first.tasks != run.tasks:
        raise InputError(run.folder.manifest, "tasks", ", ".join(first.tasks), ", ".join(run.tasks))
    for task in first.tasks:
        keys = first.keys(task)
        if {*keys} != {*run.keys(task)}:
            found = f"{len({*run.keys(task)} - {*keys})} more and {len({*keys} - {*run.keys(task)})} fewer"
            raise InputError(
                root, f"frames of {task}", f"{other} ({len(keys)})", found, "Score the same frames."
            )
        if first.manifest.protocols[task].design != run.manifest.protocols[task].design:
            raise InputError(
                root, f"protocol of {task}", f"the size and settings of scoring of {other}", "others"
            )
        for key in evenly(keys, PICTURES):
            one, two = first.ground_truth(key), run.ground_truth(key)
            gap = float(np.abs(one.astype(np.int16) - two).mean())
            if gap > SAME:
                expected = f"{other}, from one video"
                raise InputError(
                    root, f"picture of {key}", expected, f"a mean difference of {gap:.2g} levels", REMEDY
                )


def _text(value: float, number: str) -> str:
    return f"{value:{number}}" if np.isfinite(value) else "-"
