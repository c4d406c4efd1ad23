"""``headbench report trackings``: errors due to the tracking and to the method, of runs on several trackings of the same frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from ..bench.condition import label_of
from ..bench.contracts import FloatArray, FrameKey, Progress, no_progress
from ..bench.errors import InputError
from ..bench.io.files import digest
from ..bench.progress import counted
from ..bench.protocol import SEEN_CAMERAS, TASK_TITLES, UNSEEN_CAMERAS
from ..bench.rows import FULL
from ..bench.specs import CommandResult, MetricSpec, command
from ..bench.terminal import table
from .aggregate import summarise
from .runs import SPLIT_TASK, RunData, unseen_cameras
from .writers import csv_text

LEAST = 0.8
"""Minimum fraction of the scored frames of each run that all runs have."""
REMEDY = "Make the captures from the images of one, as `headbench track CAPTURE` does."


@dataclass(frozen=True)
class TrackingsSettings:
    """Separate the error due to the tracking from that due to the method: the same methods on several trackings of the same frames."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of finished runs, one for each tracking, with the same methods and settings. Conditions in a run, such as
    `tracked`, count as further trackings."""
    metrics: tuple[str, ...] = ()
    """Metrics of frames; default: PSNR and LPIPS, as far as the runs have them."""
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
    """Trivial baselines last."""
    trained: int
    """Number of the methods that are no trivial baselines."""
    values: FloatArray
    """(methods, trackings), NaN where missing."""
    chosen: tuple[int, ...]
    """Indices of the methods of the effects: trained, with a value on every tracking."""
    effects: Effects | None
    """None without such methods."""

    def text(self) -> str:
        """The table, and below it a sentence on the effects."""
        number, unit = f".{self.metric.digits}f", f" {self.metric.unit}".rstrip()
        signed = f"+z{number}"
        spans = self.values.max(axis=1) - self.values.min(axis=1)
        lines = [
            [name, *(_text(value, number) for value in (*row, span)), ""]
            for name, row, span in zip(self.methods, self.values, spans)
        ]
        below = "No trained method has a value on every tracking."
        if effects := self.effects:
            for index, effect in zip(self.chosen, effects.methods):
                lines[index][-1] = f"{effect:{signed}}"
            means = effects.mean + effects.trackings
            mean = ["mean", *(_text(value, number) for value in (*means, np.ptp(means))), ""]
            due = ["due to tracking", *(f"{effect:{signed}}" for effect in effects.trackings), "", ""]
            lines[self.trained : self.trained] = [mean, due]
            sizes = np.ptp(means), np.ptp(effects.methods), np.abs(effects.remainder).max()
            parts = [f"{size:{number}}{unit} ({share:.0%}" for size, share in zip(sizes, effects.shares)]
            below = f"Trackings differ by {parts[0]} of the variance), methods by {parts[1]}); remainder at most {parts[2]})."
        part = "whole frames" if self.region == FULL else self.region
        title = f"{TASK_TITLES.get(self.task, self.task)}, {part}: {self.metric.label}"
        title += f" ({self.metric.unit})" if unit else ""
        head = ["Method", *self.trackings, "range", "due to method"]
        return f"{table(head, lines, title=title)}\n{below}"


@command("report trackings", group="inspect")
def tracking_runs(settings: TrackingsSettings, progress: Progress = no_progress) -> CommandResult:
    """Tell the error due to the tracking from that due to the method, from runs on several trackings."""
    runs, counts = with_common_frames([RunData.read(Path(folder)) for folder in settings.runs])
    found = comparisons(runs, settings.metrics, settings.regions)
    data = [asdict(each) | {"values": _numbers(each.values)} for each in found]
    if settings.format == "csv":
        cells = [
            (each.task, each.region, each.metric.name, method, tracking, value)
            for each in found
            for method, row in zip(each.methods, _numbers(each.values))
            for tracking, value in zip(each.trackings, row)
        ]
        text = csv_text([("task", "region", "metric", "method", "tracking", "value"), *cells])
        return CommandResult(text, data, verbatim=True)
    missing = {*settings.metrics} - {each.metric.name for each in found}
    notes = [f"Not measured: {', '.join(sorted(missing))}."] if missing else []
    notes += [
        "Effects are of the trained methods. Regions are those of each capture's own tracking.",
        *counts,
    ]
    return CommandResult("\n\n".join([*(each.text() for each in found), "\n".join(notes)]), data)


def comparisons(
    runs: Sequence[RunData], metrics: Sequence[str], regions: Sequence[str]
) -> list[TrackingComparison]:
    """One for each task, region and metric with any value, of runs with the same frames and methods."""
    first, found = runs[0], []
    specs = {spec.name: spec for spec in first.manifest.metrics if spec.per_frame}
    metrics = metrics or [name for name in ("psnr", "lpips") if name in specs]
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
    methods, trained = sorted(trivial, key=trivial.__getitem__), len(trivial) - sum(trivial.values())
    unseen, _ = unseen_cameras([run.manifest for run in runs], first.keys(SPLIT_TASK))
    tasks = [
        part
        for task in first.tasks
        for part in ((SEEN_CAMERAS, UNSEEN_CAMERAS) if unseen and task == SPLIT_TASK else (task,))
    ]
    for region in regions:
        parts = [(rows.of_part(region, (), FULL), condition) for rows, condition in columns]
        if unseen:
            split = SPLIT_TASK, unseen, UNSEEN_CAMERAS, SEEN_CAMERAS
            parts = [(rows.split_by_camera(*split), condition) for rows, condition in parts]
        for task, metric in product(tasks, metrics):
            values = np.array(
                [
                    [summarise(rows, label_of(method, name), metric, task).value for rows, name in parts]
                    for method in methods
                ],
                float,
            )
            if not np.isfinite(values).any():
                continue  # no value on any tracking
            present = np.isfinite(values).all(axis=1)
            chosen = tuple(np.flatnonzero(present[:trained]).tolist())
            effects = Effects.of(values[[*chosen]]) if chosen else None
            found.append(
                TrackingComparison(
                    task, region, specs[metric], (*names,), (*methods,), trained, values, chosen, effects
                )
            )
    return found


def with_common_frames(runs: Sequence[RunData]) -> tuple[list[RunData], list[str]]:
    """Runs of the same methods with the rows of frames whose pictures all have, and sentences on how many these are.

    Trackers leave out frames, and captures number the others again; so frames are identified by their pictures.
    """
    first, counts = runs[0], []
    chosen: list[dict[str, list[FrameKey]]] = [{} for _ in runs]
    for run in runs[1:]:
        _check_same(first, run)
    for task in first.tasks if len(runs) > 1 else ():
        frames = [
            {(key.subject, digest(run.ground_truth(key))): key for key in run.keys(task)} for run in runs
        ]
        common = set.intersection(*({*known} for known in frames))
        for run, known, own in zip(runs, frames, chosen):
            own[task] = [known[name] for name in common]
            if len(common) < LEAST * len(known) or not common:
                expected = f"pictures of which at least {LEAST:.0%} are scored in all runs"
                found = f"{len(common)} of {len(known)}"
                raise InputError(run.folder.root, f"pictures of {task}", expected, found, REMEDY)
        most = max(len(known) for known in frames)
        counts.append(
            f"{TASK_TITLES.get(task, task)}: {len(common)} of {counted(most, 'frame')} in all runs."
        )
    if len(runs) > 1:
        runs = [replace(run, rows=run.rows.of_frames(keys)) for run, keys in zip(runs, chosen)]
    return [*runs], counts


def _check_same(first: RunData, run: RunData) -> None:
    """Raise `InputError` unless two runs have the same methods, tasks and definitions of metrics."""
    other = f"those of {first.folder.root}"
    methods = [
        {record.name: (record.version, record.config, record.budget) for record in each.manifest.methods}
        for each in (first, run)
    ]
    if methods[0] != methods[1]:
        differ = [n for n in methods[0] | methods[1] if methods[0].get(n) != methods[1].get(n)]
        raise InputError(
            run.folder.manifest, "methods", f"{other}, with the same settings", f"another {differ[0]}"
        )
    protocols = [", ".join(one.id for one in each.manifest.protocols.values()) for each in (first, run)]
    if protocols[0] != protocols[1]:
        raise InputError(run.folder.manifest, "protocols", f"{other}: {protocols[0]}", protocols[1])


def _numbers(values: FloatArray) -> list[list[float | None]]:
    return [[value if np.isfinite(value) else None for value in row] for row in values.tolist()]


def _text(value: float, number: str) -> str:
    return f"{value:{number}}" if np.isfinite(value) else "-"
