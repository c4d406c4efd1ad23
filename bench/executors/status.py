"""``headbench status``: the state of a run's cells, from their files and, for Slurm jobs, from the queue."""

from __future__ import annotations

import logging
import platform
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Literal

import tyro

from ..contracts import Progress, no_progress
from ..engine.store import RunFolder, TaskOutcome, read_outcome
from ..errors import HeadbenchError
from ..io.lock import is_locked
from ..manifest import Manifest
from ..progress import counted, duration
from ..rows import ALL
from ..specs import CommandResult, command
from .slurm import Queued, queue, read_submitted
from .task import TASK_LOG

log = logging.getLogger(__name__)
State = Literal["waiting", "running", "done", "failed"]
STATES: tuple[State, ...] = ("waiting", "running", "done", "failed")
SPEED = "for its speed to be measured"
SHOWN = 30
"""Maximum number of cells listed by name."""


@dataclass(frozen=True)
class CellState:
    """Current state of a cell."""

    subject: str
    method: str
    seed: int
    state: State
    note: str = ""
    """Current activity, reason for waiting, or reason of the failure."""
    seconds: float | None = None
    """Time spent so far; None if unknown."""
    restarts: int = 0

    @property
    def name(self) -> str:
        """Name in logs."""
        return f"{self.method}, subject {self.subject}, seed {self.seed}"


@command("status", group="compare")
def status(run: tyro.conf.Positional[str], progress: Progress = no_progress) -> CommandResult:
    """Show which cells of a run are waiting, running, done or failed.

    Shows the progress of a run, or of a finished run. Exit code 1: a cell failed.

    Parameters
    ----------
    run : str
        Folder of the run.
    """
    folder = RunFolder(Path(run))
    cells = cell_states(folder, folder.read_manifest())
    counts = Counter(cell.state for cell in cells)
    left, bound = time_left(cells)
    text = (
        f"{run}: {counted(len(cells), 'cell')}: {', '.join(f'{counts[state]} {state}' for state in STATES)}"
    )
    speed = sum(cell.note == SPEED for cell in cells)
    if speed:
        text += f"; {speed} of those waiting lack only their speed, which is measured last"
    if left is not None:
        text += f"; {'more than' if bound else 'about'} {duration(left)} left"
    told = [cell for state in ("failed", "running") for cell in cells if cell.state == state]
    told += [cell for cell in cells if cell.state == "waiting" and cell.note not in ("", SPEED)]
    lines = []
    for cell in told[:SHOWN]:
        notes = ", ".join(filter(None, [cell.note, f"restarts: {cell.restarts}" if cell.restarts else ""]))
        lines.append(f"{cell.state:<8} {cell.name}{': ' if notes else ''}{notes}")
    if len(told) > SHOWN:
        lines.append(f"and {len(told) - SHOWN} more")
    data = {
        "counts": {state: counts[state] for state in STATES},
        "seconds_left": left,
        "cells": [asdict(cell) for cell in cells],
    }
    return CommandResult("\n".join([text, *lines]), data, not counts["failed"])


def time_left(cells: Sequence[CellState]) -> tuple[float | None, bool]:
    """Estimated seconds until all cells are done, and whether this is a lower bound.

    The estimate uses the finished cells of each method.

    The time for measuring speed is not included. None if nothing is left, or no estimate is possible.
    """
    took: dict[str, list[float]] = {}
    for cell in cells:
        if cell.state != "running" and cell.seconds is not None:
            took.setdefault(cell.method, []).append(cell.seconds)
    means = {method: sum(each) / len(each) for method, each in took.items()}
    left = [cell for cell in cells if cell.state in ("waiting", "running")]
    begun = [cell for cell in left if cell.state == "running" or cell.seconds is None]
    estimates = [
        max(0.0, means[cell.method] - (cell.seconds or 0.0)) for cell in begun if cell.method in means
    ]
    at_once = max(1, sum(cell.state == "running" for cell in left))
    return (sum(estimates) / at_once, len(estimates) < len(left)) if estimates else (None, False)


def cell_states(folder: RunFolder, manifest: Manifest) -> list[CellState]:
    """State of each cell, in the order of execution."""
    submitted = read_submitted(folder.root)
    queued = None if submitted is None else _queue()
    jobs = {} if submitted is None else submitted["jobs"]
    failed = dict(_failed(folder, manifest))
    speed = any(metric.is_speed for metric in manifest.metrics)
    works = is_locked(folder.root)
    states = []
    for clip, method, seed in product(manifest.clips, manifest.methods, manifest.configuration.seeds):
        key = clip.subject, method.label, seed
        cell = folder.cell(*key)
        place = cell.folder.relative_to(folder.root).as_posix()
        outcome = read_outcome(cell.folder)
        if outcome is not None:
            states.append(_of_outcome(key, cell.folder, outcome, speed, jobs.get(place, ""), queued))
        elif key in failed:
            states.append(CellState(*key, "failed", failed[key]))
        elif {metric.name for metric in manifest.metrics} <= {*cell.record.get("measured", ())}:
            states.append(CellState(*key, "done"))
        elif queued and place in jobs and jobs[place] in queued:
            states.append(CellState(*key, "waiting", f"job {jobs[place]} is {queued[jobs[place]].shown}"))
        elif works and cell.folder.exists() and not jobs:
            states.append(CellState(*key, "running"))
        else:
            states.append(CellState(*key, "waiting"))
    return states


def _of_outcome(
    key: tuple[str, str, int],
    folder: Path,
    outcome: TaskOutcome,
    speed: bool,
    job: str,
    queued: Mapping[str, Queued] | None,
) -> CellState:
    seconds, restarts = outcome.get("seconds"), outcome.get("restarts", 0)
    if outcome["status"] == "failed":
        return CellState(
            *key, "failed", f"{outcome.get('reason', '')}; see {folder / TASK_LOG}", seconds, restarts
        )
    if outcome["status"] == "done":
        if speed and not outcome["speed"]:
            return CellState(*key, "waiting", SPEED, seconds, restarts)
        return CellState(*key, "done", "", seconds, restarts)
    host = outcome.get("host", "")
    if job and queued is not None:
        entry = queued.get(job)
        lives, state = entry is not None and entry.state == "RUNNING", "" if entry is None else entry.shown
    else:
        lives, state = not outcome.get("job") and (host != platform.node() or is_locked(folder)), ""
    if not lives:
        note = f"job {job} is {state}" if state else "interrupted; start the run again to continue"
        return CellState(*key, "waiting", note, seconds, restarts)
    since = datetime.fromisoformat(outcome["since"]) if "since" in outcome else datetime.now(UTC)
    elapsed = max(0.0, (datetime.now(UTC) - since).total_seconds())
    where = f"job {job} on {host}" if job else f"process {outcome.get('process')} on {host}"
    return CellState(*key, "running", f"{outcome.get('doing', '')} ({where})", elapsed, restarts)


def _failed(folder: RunFolder, manifest: Manifest) -> Iterator[tuple[tuple[str, str, int], str]]:
    """Cells that have failed rows in a run that ended, with the reason."""
    if manifest.status != "done" or not folder.rows.exists():
        return
    rows = folder.read_rows(manifest).select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    for row in rows[rows["status"] == "failed"].itertuples():
        yield (str(row.subject), str(row.method), int(str(row.seed))), str(row.reason)


def _queue() -> Mapping[str, Queued] | None:
    """Slurm's queue; None if it cannot be queried."""
    try:
        return queue()
    except HeadbenchError as error:
        log.warning("The jobs' states are not known: %s", error)
        return None
