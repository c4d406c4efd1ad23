"""The executor ``slurm``: a job of the cluster for each cell, submitted by submitit, followed by squeue and scontrol.

Jobs go on when the process that follows them ends; ``submitted.json`` tells the next one which cell is which job.
"""

from __future__ import annotations

import logging
import os
import re
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from typing_extensions import TypedDict

from ..errors import HeadbenchError, InputError
from ..io.documents import checked, read_json
from ..io.files import write_json
from ..runner.store import RunFolder
from .ended import Ended
from .outcome import forget_outcome, read_outcome
from .settings import Execution, import_submitit
from .worker import Work

log = logging.getLogger(__name__)
MAX_ARRAY = 1000
"""Jobs of an array; Slurm's own default allows 1001."""
ANSWER_S = 60
"""Seconds that Slurm has to answer a question in."""
POLLS = 3
"""A job that is gone has left no outcome after so many polls: files may appear late on a network file system."""
UNANSWERED = 100
"""Questions in a row that Slurm may leave without an answer, such as while its controller is started again."""
FINAL = {
    "CANCELLED": "was cancelled",
    "OUT_OF_MEMORY": "took more memory than execution.slurm.memory_gb",
    "DEADLINE": "missed its deadline",
}
"""Ends that would be the same another time, or that somebody wanted."""
STUCK = {"PartitionTimeLimit", "PartitionNodeLimit", "BadConstraints", "JobHeldAdmin", "JobHeldUser"}
"""Reasons to wait that do not pass."""
_THREADS = (
    "export OMP_NUM_THREADS=$SLURM_CPUS_PER_TASK",
    "export SRUN_CPUS_PER_TASK=$SLURM_CPUS_PER_TASK",  # which srun took from the job itself before Slurm 22.05
)
_JOB = re.compile(r"\d+(_\d+)?")


class Submitted(TypedDict):
    """``submitted.json``: the jobs of a pass over the cells of a run, by the cell's place in the run folder."""

    speed: bool
    jobs: dict[str, str]


def submitted_path(run: Path) -> Path:
    """Where the jobs of a run are listed."""
    return run / "submitted.json"


def read_submitted(run: Path) -> Submitted | None:
    """Read which cells are which jobs; None where there are none. Raises `InputError` for a damaged list."""
    path = submitted_path(run)
    if not path.exists():
        return None
    submitted: Submitted = checked(read_json(path), Submitted, path)
    for cell, job in submitted["jobs"].items():
        if not _JOB.fullmatch(job):
            raise InputError(path, f"jobs.{cell}", "the number of a job", repr(job))
    return submitted


@dataclass
class _Job:
    work: Work
    number: str
    polls: int = 0
    """At how many it was gone without an outcome."""


class Slurm:
    """Jobs for cells; those that ``submitted.json`` lists for this pass already are followed instead."""

    def __init__(self, folder: RunFolder, execution: Execution, speed: bool):
        self._folder, self._execution, self._speed = folder, execution, speed
        self._jobs: dict[str, _Job] = {}
        self._running = self._unanswered = 0
        self._warned: set[str] = set()
        known = read_submitted(folder.root)
        self._numbers = known["jobs"] if known is not None and known["speed"] == speed else {}
        self._known = dict(self._numbers)

    @property
    def running(self) -> int:
        """How many jobs run."""
        return self._running

    def submit(self, works: Sequence[Work]) -> None:
        """Submit jobs. Raises `InputError` where Slurm refuses them, with its words."""
        left = []
        for work in works:
            known = self._known.pop(work.cell, None)
            if known is None:
                left.append(work)
            else:
                self._jobs[work.cell] = _Job(work, known)
        if self._jobs and len(left) < len(works):
            log.info("following %d jobs that were submitted before", len(works) - len(left))
        for start in range(0, len(left), MAX_ARRAY):
            part = left[start : start + MAX_ARRAY]
            for work in part:
                forget_outcome(self._folder.root / work.cell, self._speed)
            for work, number in zip(part, self._submit(part)):
                self._jobs[work.cell] = _Job(work, number)
                self._numbers[work.cell] = number
            self._write()

    def poll(self, seconds: float) -> list[Ended]:
        """Ask Slurm after so many seconds; return the cells whose jobs have ended."""
        time.sleep(seconds)
        try:
            states = queue()
        except HeadbenchError as error:
            self._unanswered += 1
            if self._unanswered > UNANSWERED:
                raise
            log.warning("%s; it is asked again", error)
            return []
        self._unanswered = 0
        found = []
        own = [states[job.number] for job in self._jobs.values() if job.number in states]
        self._running = sum(each.state == "RUNNING" for each in own)
        for reason in {each.reason for each in own} & STUCK - self._warned:
            log.warning("jobs wait for %s, which only `scontrol` or `scancel` and other settings end", reason)
            self._warned.add(reason)
        for cell, job in list(self._jobs.items()):
            ended = None if job.number in states else self._look(job)
            if ended is not None:
                found.append(ended)
                del self._jobs[cell]
        return found

    def close(self) -> None:
        """Leave the jobs to the cluster; forget them where all have ended."""
        if self._jobs:
            log.info(
                "%d jobs go on; `headbench status` shows them, the same command follows them", len(self._jobs)
            )
        else:
            submitted_path(self._folder.root).unlink(missing_ok=True)

    def _look(self, job: _Job) -> Ended | None:
        outcome = read_outcome(self._folder.root / job.work.cell)
        if outcome is not None and outcome["speed"] == self._speed and outcome["status"] != "running":
            return Ended(job.work)
        job.polls += 1
        if job.polls < POLLS:
            return None
        state, reason = end_of(job.number)
        why = f"job {job.number} ended as {state}{reason}"
        if state in FINAL:
            return Ended(job.work, f"job {job.number} {FINAL[state]}", again=False)
        return Ended(job.work, why)

    def _write(self) -> None:
        submitted: Submitted = {"speed": self._speed, "jobs": self._numbers}
        write_json(submitted_path(self._folder.root), submitted)

    def _submit(self, works: Sequence[Work]) -> list[str]:
        submitit = import_submitit()
        settings = self._execution.slurm
        executor = submitit.SlurmExecutor(
            folder=self._folder.root / "jobs", max_num_timeout=self._execution.restarts
        )
        extra: dict[str, Any] = {"requeue": True, **settings.parameters}
        if settings.gpus:
            extra = {"gpus": settings.gpus, **extra}
        if self._speed and settings.exclusive:
            extra = {"exclusive": True, **extra}
        parameters: dict[str, Any] = {
            "job_name": f"headbench-{self._folder.root.name}",
            "time": max(1, round(settings.hours * 60)),
            "cpus_per_task": settings.cpus,
            "mem": f"{round(settings.memory_gb * 1024)}M",
            "array_parallelism": settings.parallel,
            "setup": [*settings.setup, *_THREADS],
            "additional_parameters": extra,
        }
        if settings.partition is not None:
            parameters["partition"] = settings.partition
        executor.update_parameters(**parameters)
        (self._folder.root / "jobs").mkdir(exist_ok=True)
        try:
            return [str(job.job_id) for job in executor.map_array(_call, list(works))]
        except submitit.core.utils.FailedJobError as error:
            asked = f"partition {settings.partition or 'by default'}, {settings.cpus} cpus, {settings.gpus} gpus, "
            asked += f"{settings.memory_gb:g} GB, {settings.hours:g} hours"
            remedy = "`sinfo` lists partitions and what they have."
            found = " ".join(str(error).split()).replace("sbatch: error: ", "")
            raise InputError("execution.slurm", asked, "jobs that sbatch takes", found, remedy) from error


def _call(work: Work) -> None:
    work()


class _State(NamedTuple):
    state: str
    reason: str


class Queued(NamedTuple):
    """A job that has not ended: its state, such as RUNNING, and why it waits."""

    state: str
    reason: str

    @property
    def shown(self) -> str:
        """For people."""
        return f"{self.state} ({self.reason})"


def queue() -> Mapping[str, Queued]:
    """The user's jobs that have not ended, by number."""
    lines = _ask("squeue", "-h", "-r", "-u", str(os.getuid()), "-o", "%i|%T|%r").splitlines()
    return {number: Queued(state, reason) for number, state, reason in (x.split("|", 2) for x in lines)}


def end_of(number: str) -> _State:
    """How a job ended, as long as Slurm remembers it."""
    try:
        text = _ask("scontrol", "show", "job", number)
    except HeadbenchError:
        return _State("UNKNOWN", "")
    found = dict(re.findall(r"(\w+)=(\S*)", text))
    reason = found.get("Reason", "None")
    return _State(found.get("JobState", "UNKNOWN"), "" if reason == "None" else f" ({reason})")


def _ask(*command: str) -> str:
    """What a command of Slurm answers. Raises `HeadbenchError` where it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=ANSWER_S, check=True)
    except subprocess.CalledProcessError as error:
        raise HeadbenchError(f"{command[0]}: {' '.join(error.stderr.split())}") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise HeadbenchError(f"{command[0]}: {error}") from error
    return done.stdout
