"""A task of a process or job: a function with its arguments, executed in its folder, and its outcome there."""

from __future__ import annotations

import logging
import os
import platform
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from ..engine.store import TaskOutcome, read_outcome, update_record
from ..errors import reason_of
from ..io.files import FULL_DISK
from ..io.lock import locked
from ..machine import check_device, machine_record
from ..progress import log_to_file
from ..registry import resolve

log = logging.getLogger(__name__)
TASK_LOG = "job.log"
DAMAGED = "its results are missing or damaged"


@dataclass(frozen=True)
class Task:
    """Unit of work of a process or job."""

    root: str
    """Absolute path of the output folder of the submitting command, which holds its lock."""
    place: str
    """Folder of the task relative to ``root``; no other task writes to it."""
    function: str
    """"module:name" of the function to call with the task and a callback for progress messages."""
    arguments: Mapping[str, Any]  # as JSON values
    directory: str
    path: tuple[str, ...]
    """Working directory and module search path of the submitting process, for importing plug-ins."""
    speed: bool = False
    """Whether the task measures speed and therefore must not share the machine."""
    restarts: int = 0  # after a lost process or job
    device: str = "cpu"
    name: str = ""
    """Name in progress messages; "" for ``place``."""
    cost: float = 1.0
    """Expected time, relative to the other tasks of its schedule."""

    @classmethod
    def of(cls, root: Path, place: str, function: str, **arguments: Any) -> Task:
        """Create a task of this process."""
        path = tuple(os.path.abspath(entry) for entry in sys.path)
        return cls(str(root.resolve()), place, function, arguments, os.getcwd(), path)

    @property
    def folder(self) -> Path:
        """Folder of its outcome and log."""
        return Path(self.root) / self.place


def forget_outcome(folder: Path, speed: bool) -> None:
    """Remove the outcome of an earlier pass of the same kind, so that a new pass does not read it."""
    outcome = read_outcome(folder)
    if outcome is not None and outcome["speed"] == speed:
        update_record(folder, task=None)


class TaskResult(NamedTuple):
    """A task whose process or job has ended; its outcome, if any, records how."""

    task: Task
    lost: str = ""
    """Reason why the outcome may be missing; "" after a regular end."""
    again: bool = True
    """Whether to restart the task if there is no outcome."""


class Executor(Protocol):
    """Runs tasks in worker processes or on Slurm."""

    @property
    def running(self) -> Sequence[Task]:
        """The running tasks."""

    def submit(self, tasks: Sequence[Task]) -> None:
        """Start these tasks."""

    def poll(self, seconds: float) -> list[TaskResult]:
        """Wait at most ``seconds`` for tasks to end; return the results of those that ended."""

    def close(self) -> None:
        """Release processes and jobs; called once, also after an error."""


def execute_task(task: Task) -> None:
    """Execute a task. Failures are recorded in ``cell.json``, with its log in ``job.log``.

    Another process that executes the task, and a full or read-only disk (`OSError`), do not mark it as failed.
    """
    folder = task.folder
    start = time.monotonic()
    outcome: TaskOutcome = {
        "status": "running",
        "speed": task.speed,
        "doing": "starting",
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
        "restarts": task.restarts + int(os.environ.get("SLURM_RESTART_COUNT", "0")),
        "job": _job_id(),
        "process": os.getpid(),
        "host": platform.node(),
        "threads": os.environ.get("OMP_NUM_THREADS", ""),
    }
    with locked(folder), _output_to(folder), log_to_file(folder / TASK_LOG):
        before = 0.0
        first = read_outcome(folder) if task.speed else None
        if first is not None and not first["speed"]:
            before = first.get("seconds", 0.0)
            outcome["restarts"] += first.get("restarts", 0)
        update_record(folder, task=outcome)
        try:
            check_device(task.device)
            outcome["machine"] = _machine(task.device)
            resolve(task.function)(
                task, lambda doing: update_record(folder, task={**outcome, "doing": doing})
            )
            end: TaskOutcome = {**outcome, "status": "done"}
        except Exception as error:
            if isinstance(error, OSError) and error.errno in FULL_DISK:
                raise
            log.exception("failed")
            end = {**outcome, "status": "failed", "reason": reason_of(error)}
        del end["doing"]
        update_record(folder, task={**end, "seconds": round(before + time.monotonic() - start, 3)})


_machine = cache(machine_record)


def _job_id() -> str:
    """Number of this process's Slurm job, "" for none."""
    array, task = (os.environ.get(f"SLURM_ARRAY_{name}") for name in ("JOB_ID", "TASK_ID"))
    return f"{array}_{task}" if array and task else os.environ.get("SLURM_JOB_ID", "")


@contextmanager
def _output_to(folder: Path) -> Iterator[None]:
    """Redirect all output of the process and its children, including native code, to the task's log within the block."""
    sys.stdout.flush()
    sys.stderr.flush()
    before = [os.dup(number) for number in (1, 2)]
    with open(folder / TASK_LOG, "a", encoding="utf-8") as stream:
        for number in (1, 2):
            os.dup2(stream.fileno(), number)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for number, kept in zip((1, 2), before):
            os.dup2(kept, number)
            os.close(kept)
