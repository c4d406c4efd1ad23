"""``headbench run --dry-run``: the cells of a run and their estimated cost, from earlier cells."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from ..manifest import Manifest, MethodRecord
from ..progress import duration
from ..specs import CommandResult
from .disk import shown
from .job import Job
from .store import Cell, RunFolder


class Cost(NamedTuple):
    """Cost of a cell: seconds of training, bytes on disk, bytes of memory; None if unknown."""

    seconds: float | None
    disk: float | None
    memory: float | None


class _Known(NamedTuple):
    """A trained cell of an earlier run."""

    record: MethodRecord
    cell: Cell
    frames: int


def forecast(jobs: Sequence[Job], runs: Sequence[Path]) -> CommandResult:
    """List cells with their state and an estimate of their remaining cost.

    The estimate of a cell is the mean over the trained cells of its method in ``runs``: seconds are scaled by
    the iterations, disk usage by the frames, and memory is not scaled.

    Parameters
    ----------
    runs : Sequence[Path]
        Folders of earlier runs on a similar machine, including the run's own folder.
    """
    known = [each for run in runs for each in _trained(run)]
    lines, cells = [], []
    total = Cost(0.0, 0.0, 0.0)
    for job in jobs:
        trained = job.cell.is_done("fit", job.fit_fingerprint)
        state = "done" if trained and job.cell.ended("measure") else "trained" if trained else "to train"
        trained = trained or job.source is not None
        cost = Cost(0.0, 0.0, 0.0) if state == "done" else _estimate(job, known, trained)
        total = Cost(_sum(total.seconds, cost.seconds), _sum(total.disk, cost.disk), _most(total, cost))
        lines.append(f"{job.name:<40} {state:<9} {_text(cost)}")
        cells.append({"cell": job.name, "state": state, **cost._asdict()})
    lines.append(f"{'all, one after another':<40} {'':<9} {_text(total)}")
    if any(cell["seconds"] is None for cell in cells):
        lines.append("unknown: no trained cell of the method; name a run that has one with --estimates RUN.")
    return CommandResult("\n".join(lines), {"cells": cells, "total": total._asdict()})


def _trained(run: Path) -> Iterator[_Known]:
    folder = RunFolder(run)
    manifest: Manifest = folder.read_manifest()
    frames = sum(len(protocol.keys) for protocol in manifest.protocols.values())
    for record in manifest.methods:
        for clip in manifest.clips:
            for seed in manifest.configuration.seeds:
                cell = folder.cell(clip.subject, record.label, seed)
                if cell.ended("fit"):
                    yield _Known(record, cell, max(1, frames // len(manifest.clips)))


def _estimate(job: Job, known: Sequence[_Known], trained: bool) -> Cost:
    own = [each for each in known if each.record.name == job.method.spec.name]
    frames = len(job.frame_paths)
    seconds, disk, memory = [], [], []
    for each in own:
        state: Mapping[str, Any] = each.cell.step("fit") or {}
        before, now = each.record.budget.get("iterations"), job.method.budget.iterations
        if "seconds" in state and (before and now or before == now):
            seconds.append(state["seconds"] * (now / before if before and now else 1.0))
        sizes = [_size(each.cell.avatar), _size(each.cell.folder / "renders") * frames / each.frames]
        disk.append(sizes[0] * (not trained) + sizes[1])
        if "peak_memory_bytes" in state:
            memory.append(float(state["peak_memory_bytes"]))
    return Cost(0.0 if trained else _mean(seconds), _mean(disk), _mean(memory))


def _size(folder: Path) -> float:
    return float(sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file()))


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None


def _sum(first: float | None, second: float | None) -> float | None:
    return None if first is None or second is None else first + second


def _most(first: Cost, second: Cost) -> float | None:
    return None if first.memory is None or second.memory is None else max(first.memory, second.memory)


def _text(cost: Cost) -> str:
    seconds = "unknown" if cost.seconds is None else duration(cost.seconds)
    disk, memory = ("unknown" if each is None else shown(each) for each in (cost.disk, cost.memory))
    return f"time {seconds}, disk {disk}, memory {memory}"
