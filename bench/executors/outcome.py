"""``outcome.json`` of a task: what its process or job is doing, or how it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Required

from typing_extensions import TypedDict

from ..errors import InputError
from ..io.documents import checked, read_json
from ..io.files import write_json


class TaskOutcome(TypedDict, total=False):
    """Attributes.

    status : how a task ended; a job that is gone while it says "running" was killed.
    speed : whether speed is measured, too: a pass of its own over a run's cells, see `bench.executors.run`.
    reason : why it failed, as in the rows of a cell.
    doing, since : the step it is at, and the time (ISO 8601, UTC) when it was begun.
    seconds : that it took.
    restarts : how often it was started again.
    job : of the cluster, "" for a process of ``host``.
    threads : what OMP_NUM_THREADS said, "" for as many as there are cores.
    machine : see `machine_record`.
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
    """Where the outcome of the task in a folder lies."""
    return task / "outcome.json"


def read_outcome(task: Path) -> TaskOutcome | None:
    """Read the outcome of the task in a folder; None where there is none. Raises `InputError` for a damaged one."""
    path = outcome_path(task)
    if not path.exists():
        return None
    outcome: TaskOutcome = checked(read_json(path), TaskOutcome, path)
    return outcome


def write_outcome(task: Path, outcome: TaskOutcome) -> None:
    """Write it, atomically."""
    write_json(outcome_path(task), outcome)


def forget_outcome(task: Path, speed: bool) -> None:
    """Remove the outcome of an earlier pass of the same kind, so that it is not taken for that of one that begins."""
    try:
        outcome = read_outcome(task)
    except InputError:  # damaged
        outcome = None
    if outcome is None or outcome["speed"] == speed:
        outcome_path(task).unlink(missing_ok=True)
