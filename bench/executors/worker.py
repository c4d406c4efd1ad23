"""Executes one task in a process or job and writes the outcome to the task's folder."""

from __future__ import annotations

import errno
import logging
import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import reason_of
from .task import TASK_LOG, Task

if TYPE_CHECKING:
    from .outcome import TaskOutcome

log = logging.getLogger(__name__)
FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""System errors that would affect every other task."""


def execute_task(task: Task) -> None:
    """Execute a task. Failures are recorded in ``cell.json``, with its log in ``job.log``.

    Raises
    ------
    InputError
        Another process executes the task.
    OSError
        The disk is full or read-only.
    """
    from ..io.files import output_inside
    from ..io.lock import locked
    from ..machine import check_device
    from ..progress import log_to_file
    from ..registry import resolve
    from .outcome import read_outcome, write_outcome

    folder = task.folder
    start = time.monotonic()
    outcome: TaskOutcome = {
        "status": "running",
        "speed": task.speed,
        "doing": "starting",
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
        "restarts": task.restarts + int(os.environ.get("SLURM_RESTART_COUNT", "0")),
        "job": job_id(),
        "process": os.getpid(),
        "host": platform.node(),
        "threads": os.environ.get("OMP_NUM_THREADS", ""),
    }
    with output_inside(Path(task.root)), locked(folder), _output_to(folder), log_to_file(folder / TASK_LOG):
        before = 0.0
        first = read_outcome(folder) if task.speed else None
        if first is not None and not first["speed"]:
            before = first.get("seconds", 0.0)
            outcome["restarts"] += first.get("restarts", 0)
        write_outcome(folder, outcome)
        try:
            check_device(task.device)
            outcome["machine"] = _machine(task.device)
            resolve(task.function)(task, lambda doing: write_outcome(folder, {**outcome, "doing": doing}))
            ended: TaskOutcome = {**outcome, "status": "done"}
        except Exception as error:
            if isinstance(error, OSError) and error.errno in FULL_DISK:
                raise
            log.exception("failed")
            ended = {**outcome, "status": "failed", "reason": reason_of(error)}
        del ended["doing"]
        write_outcome(folder, {**ended, "seconds": round(before + time.monotonic() - start, 3)})


def run_job(task: Task) -> None:
    """Run a task in a separate job. Raises errors that must not mark the task as failed."""
    os.chdir(task.directory)
    sys.path += [entry for entry in task.path if entry not in sys.path]
    try:
        execute_task(task)
    except OSError as error:
        if error.errno not in FULL_DISK:
            raise
        print(f"{error.filename}: {error.strerror}", file=sys.stderr, flush=True)
        os._exit(error.errno)  # the disk may be too full for its outcome and log


def _continued(task: Task) -> Any:
    """The job that submitit resubmits after a timeout: the same job, which resumes."""
    from submitit.helpers import DelayedSubmission

    return DelayedSubmission(run_job, task)


run_job.__dict__["checkpoint"] = _continued


@cache
def _machine(device: str) -> dict[str, Any]:
    from ..machine import machine_record

    return machine_record(device)


def job_id() -> str:
    """Number of this process's Slurm job, "" for none."""
    array, task = (os.environ.get(f"SLURM_ARRAY_{part}") for part in ("JOB_ID", "TASK_ID"))
    return f"{array}_{task}" if array and task else os.environ.get("SLURM_JOB_ID", "")


@contextmanager
def _output_to(folder: Path) -> Iterator[None]:
    """Redirect all output of the process and its children, including native code, to the task's log within the block."""
    from ..io.files import no_link

    sys.stdout.flush()
    sys.stderr.flush()
    before = [os.dup(number) for number in (1, 2)]
    with open(folder / TASK_LOG, "a", encoding="utf-8", opener=no_link) as stream:
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
