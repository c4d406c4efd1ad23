"""``outcome.json`` of a task: current activity of its process or job, or how it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Required

from typing_extensions import TypedDict

from ..errors import InputError
from ..io.documents import checked, read_json
from ..io.files import write_json


class TaskOutcome(TypedDict, total=False):
    """Content of ``outcome.json``.

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


def outcome_path(task: Path) -> Path:
    """Path of the outcome of the task in a folder."""
    return task / "outcome.json"


def read_outcome(task: Path) -> TaskOutcome | None:
    """Read the outcome of a task's folder; None if it is missing. Raises `InputError` for a damaged one."""
    path = outcome_path(task)
    if not path.exists():
        return None
    outcome: TaskOutcome = checked(read_json(path), TaskOutcome, path)
    return outcome


def write_outcome(task: Path, outcome: TaskOutcome) -> None:
    """Write the file atomically."""
    write_json(outcome_path(task), outcome)


def forget_outcome(task: Path, speed: bool) -> None:
    """Remove the outcome of an earlier pass of the same kind, so that a new pass does not read it."""
    try:
        outcome = read_outcome(task)
    except InputError:  # damaged
        outcome = None
    if outcome is None or outcome["speed"] == speed:
        outcome_path(task).unlink(missing_ok=True)
