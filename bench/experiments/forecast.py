"""Hours and disk space of runs on recordings, from a few images, iterations and frames that are measured in place."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..condition import PLAIN, Condition, label_of
from ..configuration import merge
from ..contracts import Progress
from ..engine.config import RunConfig, resolve_cells, with_methods
from ..engine.run import run
from ..engine.store import RunFolder
from ..executors.settings import Execution
from ..registry import get

if TYPE_CHECKING:
    from ...datasets.nersemble.plan import PreparationPlan

TIMESTEPS, FRAMES = 4, 8
"""Timesteps of each sequence, and scored frames of each task, with which rates are measured."""
WARM_UP, HALF = Condition("warm-up", budget="1/8"), Condition("half", budget="1/2")
"""A training before those that are timed, and one of half the iterations: the difference leaves out what a training does once."""


@dataclass(frozen=True)
class MethodRates:
    """Measured costs of a method; None for a training that failed or has no iterations."""

    iteration_s: float | None
    frame_s: float
    """Seconds to render and measure a frame."""
    frame_bytes: float
    """Bytes of a stored render."""


@dataclass(frozen=True)
class Rates:
    """Measured costs of an image of a capture, and of each method."""

    image_s: float
    image_bytes: float
    methods: dict[str, MethodRates]


@dataclass(frozen=True)
class Amounts:
    """Subjects, images to convert and frames to score of a part."""

    subjects: int
    images: int
    frames: int

    @classmethod
    def of(cls, plans: Sequence[PreparationPlan]) -> Amounts:
        """Count what recordings hold, before frames that show the tongue are left out."""
        jobs = [(plan, job) for plan in plans for job in plan.jobs]
        images = sum(job.count * len(job.cameras) for _, job in jobs)
        frames = 0
        for plan, job in jobs:
            held_out = [camera for camera in job.cameras if camera.id in plan.novel_views]
            frames += job.count * len(job.cameras if job.recorded.name in plan.test else held_out)
        return cls(len(plans), images, frames)


def measure(
    runs: Mapping[str, RunConfig],
    recording: PreparationPlan,
    timed: int,
    execution: Execution,
    folder: Path,
    progress: Progress,
) -> Rates:
    """Convert a few timesteps of a recording into ``folder``, and train and measure every method of the runs on them.

    Early iterations have fewer splats than later ones, so that hours are a lower bound.
    """
    from ...datasets.nersemble.plan import shortened
    from ...datasets.nersemble.prepare import prepare

    shutil.rmtree(folder, ignore_errors=True)  # an interrupted measurement has no times
    captures = folder / "captures"
    start = time.perf_counter()
    (result,) = prepare([shortened(recording, TIMESTEPS, captures)], progress=progress)
    seconds = time.perf_counter() - start
    methods: dict[str, MethodRates] = {}
    for name, config in runs.items():
        budgets = {m.spec.name: m.budget.iterations for m, _ in resolve_cells(config)}
        left = [method for method in budgets if method not in methods]
        if not left:
            continue
        config = with_methods(replace(config, conditions=(WARM_UP, PLAIN, HALF)), left)
        few = {method: {"budget": {"iterations": timed}} for method in left if budgets[method]}
        config = replace(
            config,
            data=str(captures),
            out=str(folder / name),
            reader_settings={k: v for k, v in config.reader_settings.items() if k != "exclude"},
            settings=merge(config.settings, few),
            frames_per_task=FRAMES,
            metrics=tuple(each for each in config.metrics if get("metrics", each).per_frame),
        )
        finished = run(config, execution, unchecked=True, reports=False).folder
        methods |= {method: _rates(finished, recording.subject, method, timed) for method in left}
    written = sum(path.stat().st_size for path in captures.rglob("*.png"))
    return Rates(seconds / result.written, written / result.written, methods)


def _rates(folder: RunFolder, subject: str, method: str, timed: int) -> MethodRates:
    """Rates of a method from its cells of both lengths."""
    cells = [folder.cell(subject, label_of(method, name), 0) for name in ("", HALF.name)]
    whole, half = (cell.record.get("training", {}).get("seconds", 0.0) for cell in cells)
    renders = [*cells[0].folder.glob("renders/*/*.png")]
    iteration = None
    if whole and half:
        is_longer = whole > half
        iteration = (whole - half) / (timed - max(1, round(timed / 2))) if is_longer else whole / timed
    if not renders:
        return MethodRates(iteration, 0.0, 0.0)
    trained = cells[0].record.get("training", {}).get("finished_at", 0.0)
    scored = cells[0].rows.stat().st_mtime - trained
    size = sum(path.stat().st_size for path in renders)
    return MethodRates(iteration, scored / len(renders), size / len(renders))


def runs_of(part: str, runs: Mapping[str, RunConfig]) -> dict[str, RunConfig]:
    """The runs of a part, with whose name theirs begin."""
    return {name: config for name, config in runs.items() if name.startswith(part)}


def bytes_left(
    rates: Rates, runs: Mapping[str, RunConfig], recordings: Mapping[str, Sequence[PreparationPlan]]
) -> float:
    """Bytes still to be written: those of images that are not there, and of renders of cells that are not scored."""
    from ...datasets.nersemble.prepare import count_images

    size = 0.0
    for part, plans in recordings.items():
        for job in (job for plan in plans for job in plan.jobs):
            size += (job.count * len(job.cameras) - count_images(job)) * rates.image_bytes
        for config in runs_of(part, runs).values():
            for plan, (method, condition), seed in product(plans, resolve_cells(config), config.seeds):
                label = label_of(method.spec.name, condition.name)
                cell = RunFolder(Path(config.out)).cell(plan.subject, label, seed)
                if not cell.rows.exists():
                    frames = Amounts.of([plan]).frames - len([*cell.folder.glob("renders/*/*.png")])
                    size += frames * rates.methods[method.spec.name].frame_bytes
    return size


def forecast(rates: Rates, runs: Mapping[str, RunConfig], amounts: Mapping[str, Amounts]) -> dict[str, Any]:
    """Hours and GB of each step and in all, and a table of them.

    ``amounts`` are those of each part.
    """
    steps: list[tuple[str, str, int, float | None, float]] = []
    for part, amount in amounts.items():
        size = amount.images * rates.image_bytes
        steps.append((part, "images of captures", amount.images, rates.image_s, size))
        for name, config in runs_of(part, runs).items():
            for method, condition in resolve_cells(config):
                each, label = rates.methods[method.spec.name], label_of(method.spec.name, condition.name)
                if method.budget.iterations:
                    count = amount.subjects * method.budget.iterations * len(config.seeds)
                    steps.append((name, f"{label}: iterations", count, each.iteration_s, 0.0))
                count = amount.frames * len(config.seeds)
                steps.append((name, f"{label}: frames", count, each.frame_s, count * each.frame_bytes))
    lines = [["part", "step", "number", "ms each", "hours", "GB"], ["---", "---", *["--:"] * 4]]
    hours, size = 0.0, 0.0
    for part, step, count, seconds, held in steps:
        hours, size = hours + count * (seconds or 0.0) / 3600, size + held
        times = (
            ["failed"] * 2 if seconds is None else [f"{1e3 * seconds:.1f}", f"{count * seconds / 3600:.3g}"]
        )
        lines.append([part, step, f"{count:,}", *times, f"{held / 1e9:.3g}" if held else ""])
    lines.append(["all", "", "", "", f"{hours:.3g}", f"{size / 1e9:.3g}"])
    return {"hours": hours, "bytes": size, "lines": lines, "failed": [s[1] for s in steps if s[3] is None]}
