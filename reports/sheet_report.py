"""The contact sheet of a run folder."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

from ..bench.contracts import FrameKey
from ..bench.protocol import TASK_TITLES
from ..bench.specs import MetricSpec
from .contact_sheet import Missing, Picture, SheetRow, contact_sheet
from .run_data import RunData

FRAMES_PER_TASK = 3
Item = TypeVar("Item")


def write_contact_sheet(run_folder: Path, frames_per_task: int = FRAMES_PER_TASK) -> list[Path]:
    """Draw some frames of each task, evenly spaced over its sorted keys; return the file written."""
    data = RunData.read(run_folder)
    metric = next((m for m in data.metrics if m.per_frame), None)
    rows = [
        _row(data, task, key, metric)
        for task in data.tasks
        for key in evenly_spaced(data.keys(task), frames_per_task)
    ]
    protocols = ", ".join(
        f"{identifier} ({data.manifest.protocols[task].hash})"
        for task, identifier in data.protocol_ids.items()
    )
    path = data.folder.contact_sheet
    ranked = [method for method in data.methods if method not in data.trivial]
    contact_sheet(
        rows,
        data.methods,
        path,
        title=f"headbench: {', '.join(dict.fromkeys(key.subject for t in data.tasks for key in data.keys(t)))}",
        subtitle=f"Frames evenly spaced over each task. Protocol {protocols}. Seed {data.seed}.",
        scaled_by=ranked or None,
    )
    return [path]


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """At most ``count`` items, each in the middle of its equal share of the sequence."""
    count = min(count, len(items))
    return [items[(2 * i + 1) * len(items) // (2 * count)] for i in range(count)]


def _row(data: RunData, task: str, key: FrameKey, metric: MetricSpec | None) -> SheetRow:
    renders: dict[str, Picture | Missing] = {}
    captions: dict[str, str] = {}
    for method in data.methods:
        render = data.render(method, task, key)
        renders[method] = Missing(data.reason(method, task, key)) if render is None else render
        value = data.value(metric.name, method, task, key) if metric else None
        if metric and value is not None:
            captions[method] = f"{metric.label} {value:.{metric.digits}f} {metric.unit}".rstrip()
    return SheetRow(
        section=TASK_TITLES.get(task, task),
        labels=(key.sequence, f"subject {key.subject}", f"timestep {key.timestep}", f"camera {key.camera}"),
        truth=partial(data.truth, key),
        renders=renders,
        captions=captions,
    )
