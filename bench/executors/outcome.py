"""Outcome of a task in the ``cell.json`` of its folder: current activity of its process or job, or how it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Required

from typing_extensions import TypedDict

from ..io.documents import checked, read_json
from ..io.files import write_json


class TaskOutcome(TypedDict, total=False):
    """Entry ``task`` of ``cell.json``.

    Attributes
    ----------
    status : Literal["running", "done", "failed"]
        State of the task; a job that no longer exists while it is "running" was killed.
    speed : bool
        Whether speed is measured, in a separate pass over a run's cells, see `bench.executors.run`.
    reason : str
        Reason of the failure, as in the rows of a cell.
    doing, since : str
        Current step, and the time of its start (ISO 8601, UTC).
    seconds : float
        Time that the task took.
    restarts : int
        Number of restarts.
    job : str
        Job of the cluster, "" for a process of ``host``.
    threads : str
        Value of OMP_NUM_THREADS, "" for the number of cores.
    machine : dict[str, Any]
        See `machine_record`.
    """

    status: Required[Literal["running", "done", "failed"]]
    speed: Required[bool]
    reason: str
    doing: str
    since: str
    seconds: float
    restarts: int
    job: str
    process: int
    host: str
    threads: str
    machine: dict[str, Any]


def record_path(folder: Path) -> Path:
    """The record of a cell, or of another task, in its folder."""
    return folder / "cell.json"


def read_record(folder: Path) -> dict[str, Any]:
    """Read the record of a folder; empty if it is missing."""
    path = record_path(folder)
    return read_json(path) if path.exists() else {}


def update_record(folder: Path, **changes: Any) -> None:
    """Write entries of the record atomically; None removes one."""
    record = {**read_record(folder), **changes}
    write_json(record_path(folder), {key: value for key, value in record.items() if value is not None})


def read_outcome(task: Path) -> TaskOutcome | None:
    """Read the outcome of a task's folder; None if it is missing. Raises `InputError` for a damaged one."""
    found = read_record(task).get("task")
    return None if found is None else checked(found, TaskOutcome, record_path(task), "task")


def write_outcome(task: Path, outcome: TaskOutcome) -> None:
    """Write the outcome into the record."""
    update_record(task, task=outcome)


def forget_outcome(task: Path, speed: bool) -> None:
    """Remove the outcome of an earlier pass of the same kind, so that a new pass does not read it."""
    outcome = read_outcome(task)
    if outcome is not None and outcome["speed"] == speed:
        update_record(task, task=None)
