"""The executor ``slurm``: a job of the cluster for each task, submitted by submitit, followed by squeue and scontrol.

Jobs continue if the process that polls them ends; ``submitted.json`` lists their tasks for the next process.
"""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from typing_extensions import TypedDict

from ..engine.store import read_outcome
from ..errors import HeadbenchError, InputError, UnavailableError
from ..io.documents import checked, read_json
from ..io.files import FULL_DISK, check_room, digest, write_json
from .settings import Execution, import_submitit
from .task import Task, TaskResult, execute_task, forget_outcome

log = logging.getLogger(__name__)
MAX_ARRAY = 1000
"""Jobs of an array; Slurm's own default allows 1001."""
ANSWER_S = 60
"""Timeout of Slurm commands, seconds."""
POLLS = 3
"""Polls after which a job that no longer exists counts as lost: network file systems are slow."""
CANCEL_S = 120.0
"""Time for cancelled jobs to end, seconds; Slurm kills them after its KillWait, 30 seconds by default."""
UNANSWERED = 100
"""Consecutive queries that may fail, for example while Slurm's controller restarts."""
FINAL = {
    "CANCELLED": "was cancelled",
    "OUT_OF_MEMORY": "took more memory than execution.slurm.memory_gb",
    "DEADLINE": "missed its deadline",
}
"""Final states for which a restart would not help or is not wanted."""
STUCK = {"PartitionTimeLimit", "PartitionNodeLimit", "BadConstraints", "JobHeldAdmin", "JobHeldUser"}
"""Reasons of pending jobs that are permanent."""
WAITING = "jobs wait for %s, which does not resolve by itself. To change their settings, end them by `scancel --name %s` and start again"
_THREADS = (
    "export OMP_NUM_THREADS=$SLURM_CPUS_PER_TASK",
    "export SRUN_CPUS_PER_TASK=$SLURM_CPUS_PER_TASK",  # before Slurm 22.05, srun used the job's value itself
)
_JOB = re.compile(r"\d+(_\d+)?")


class Submitted(TypedDict):
    """``submitted.json``: jobs by the task's folder in the output folder; ``speed`` as in `Task`."""

    speed: bool
    jobs: dict[str, str]


def submitted_path(root: Path) -> Path:
    """Path of the list of jobs of an output folder."""
    return root / "submitted.json"


def read_submitted(root: Path) -> Submitted | None:
    """Read the jobs of tasks; None without a list."""
    path = submitted_path(root)
    if not path.exists():
        return None
    submitted: Submitted = checked(read_json(path), Submitted, path)
    for place, job in submitted["jobs"].items():
        if not _JOB.fullmatch(job):
            raise InputError(path, f"jobs.{place}", "the number of a job", repr(job))
    return submitted


@dataclass
class _Job:
    task: Task
    number: str
    polls: int = 0
    """Number of polls without the job and its outcome."""
    earlier: bool = False
    """Submitted by an earlier process."""


class Slurm:
    """Jobs for tasks; jobs listed in ``submitted.json`` are polled instead of submitted again.

    A process that was killed between submitting and listing jobs leaves unlisted jobs. They are found by
    their name, which is specific to the output folder, and cancelled before new jobs are submitted.
    """

    def __init__(self, root: Path, execution: Execution, speed: bool):
        self._root, self._execution, self._speed = root, execution, speed
        self._jobs: dict[str, _Job] = {}
        self._running: list[Task] = []
        self._unanswered = 0
        self._warned: set[str] = set()
        submitted = read_submitted(root)
        self._numbers = submitted["jobs"] if submitted is not None and submitted["speed"] == speed else {}
        self._known = dict(self._numbers)
        self._strays_gone = False

    @property
    def running(self) -> Sequence[Task]:
        """The tasks of running jobs."""
        return self._running

    def submit(self, tasks: Sequence[Task]) -> None:
        """Submit jobs."""
        left = []
        for task in tasks:
            number_before = self._known.pop(task.place, None)
            if number_before is None:
                left.append(task)
            else:
                self._jobs[task.place] = _Job(task, number_before, earlier=True)
        if self._jobs and len(left) < len(tasks):
            log.info(
                "following %d jobs that were submitted before, with their earlier settings",
                len(tasks) - len(left),
            )
        if left and not self._strays_gone:
            _cancel_others(job_name(self._root), set(self._numbers.values()))
            self._strays_gone = True
        for start in range(0, len(left), MAX_ARRAY):
            array = left[start : start + MAX_ARRAY]
            for task in array:
                forget_outcome(task.folder, self._speed)
            for task, number in zip(array, self._submit(array)):
                self._jobs[task.place] = _Job(task, number)
                self._numbers[task.place] = number
            submitted: Submitted = {"speed": self._speed, "jobs": self._numbers}
            write_json(submitted_path(self._root), submitted)

    def poll(self, seconds: float) -> list[TaskResult]:
        """Wait ``seconds``, then query Slurm; return the results of jobs that have ended."""
        time.sleep(seconds)
        try:
            states = queue()
        except HeadbenchError as error:
            self._unanswered += 1
            if self._unanswered > UNANSWERED:
                raise
            log.warning("%s; trying again", error)
            return []
        self._unanswered = 0
        results = []
        listed = [(job.task, states[job.number]) for job in self._jobs.values() if job.number in states]
        self._running = [task for task, each in listed if each.state == "RUNNING"]
        for reason in {each.reason for _, each in listed} & STUCK - self._warned:
            log.warning(WAITING, reason, job_name(self._root))
            self._warned.add(reason)
        for place, job in list(self._jobs.items()):
            ended = None if job.number in states else self._look(job)
            if ended is not None:
                results.append(ended)
                del self._jobs[place]
        return results

    def close(self) -> None:
        """Leave the jobs to the cluster; remove the list if all have ended."""
        if self._jobs:
            log.info(
                "%d jobs continue on the cluster; `headbench status` shows their state, the same command attaches to them again",
                len(self._jobs),
            )
        else:
            submitted_path(self._root).unlink(missing_ok=True)

    def _look(self, job: _Job) -> TaskResult | None:
        outcome = read_outcome(job.task.folder)
        if outcome is not None and outcome["speed"] == self._speed and outcome["status"] != "running":
            return TaskResult(job.task)
        job.polls += 1
        if job.polls < POLLS:
            return None
        state, reason, code = end_of(job.number)
        if state in FINAL and not (job.earlier and state == "CANCELLED"):  # a restart requests it again
            return TaskResult(job.task, f"job {job.number} {FINAL[state]}", again=False)
        if code in FULL_DISK and not job.earlier:  # there may be space by now; see `run_job`
            raise OSError(code, f"{os.strerror(code)} (job {job.number})", str(job.task.folder))
        check_room(self._root)  # a job that could not open its log leaves no reason
        return TaskResult(job.task, f"job {job.number} ended as {state}{reason}")

    def _submit(self, tasks: Sequence[Task]) -> list[str]:
        submitit = import_submitit()
        settings = self._execution.slurm
        folder = self._root / "jobs"
        executor = submitit.SlurmExecutor(folder=folder, max_num_timeout=self._execution.restarts)
        extra: dict[str, Any] = {"requeue": True, **settings.parameters}
        if settings.gpus:
            extra = {"gpus": settings.gpus, **extra}
        if self._speed and settings.exclusive:
            extra = {"exclusive": True, **extra}
        parameters: dict[str, Any] = {
            "job_name": job_name(self._root),
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
        folder.mkdir(exist_ok=True)
        try:
            return [str(job.job_id) for job in executor.map_array(run_job, list(tasks))]
        except OSError as error:
            error.filename = error.filename or str(folder)  # the system reports a full disk without a name
            raise
        except submitit.core.utils.FailedJobError as error:
            asked = f"partition {settings.partition or 'by default'}, {settings.cpus} cpus, {settings.gpus} gpus, "
            asked += f"{settings.memory_gb:g} GB, {settings.hours:g} hours"
            remedy = "`sinfo` lists partitions and what they have."
            answer = " ".join(str(error).split()).replace("sbatch: error: ", "")
            raise InputError("execution.slurm", asked, "jobs that sbatch takes", answer, remedy) from error


def run_job(task: Task) -> None:
    """Run a task in a separate job."""
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


def job_name(root: Path) -> str:
    """Name of all jobs of an output folder, unique to it."""
    return f"headbench-{root.name}-{digest(str(root.resolve()))[:8]}"


def _cancel_others(name: str, numbers: set[str]) -> None:
    """Cancel unlisted jobs with this name, and wait until they have ended, since they may be running."""
    strays = [number for number, job in queue().items() if job.name == name and number not in numbers]
    if not strays:
        return
    log.warning("%d jobs that an earlier process submitted and did not list are cancelled", len(strays))
    _ask("scancel", *strays)
    end = time.monotonic() + CANCEL_S
    while left := sorted(queue().keys() & set(strays)):
        if time.monotonic() > end:
            what = f"Jobs {', '.join(left[:5])} of an earlier start do not end."
            raise UnavailableError(what, "End them with `scancel` and start again.")
        time.sleep(1.0)


class _State(NamedTuple):
    state: str
    reason: str
    code: int


class Queued(NamedTuple):
    """A job that has not ended: its state, such as RUNNING, the reason why it waits, and its name."""

    state: str
    reason: str
    name: str

    @property
    def shown(self) -> str:
        """Description for messages."""
        return f"{self.state} ({self.reason})"


def queue() -> Mapping[str, Queued]:
    """The user's jobs that have not ended, by number."""
    lines = _ask("squeue", "-h", "-r", "-u", str(os.getuid()), "-o", "%i|%T|%r|%j").splitlines()
    return {number: Queued(*fields) for number, *fields in (line.split("|", 3) for line in lines)}


def end_of(number: str) -> _State:
    """Final state of a job, while Slurm keeps its record."""
    try:
        text = _ask("scontrol", "show", "job", number)
    except HeadbenchError:
        return _State("UNKNOWN", "", 0)
    fields = dict(re.findall(r"(\w+)=(\S*)", text))
    reason = fields.get("Reason", "None")
    code = fields.get("ExitCode", "0").partition(":")[0]
    return _State(fields.get("JobState", "UNKNOWN"), "" if reason == "None" else f" ({reason})", int(code))


def _ask(*command: str) -> str:
    """Output of a Slurm command."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=ANSWER_S, check=True)
    except subprocess.CalledProcessError as error:
        hint = "`scontrol ping` shows whether Slurm responds."
        raise HeadbenchError(f"{command[0]}: {' '.join(error.stderr.split())}. {hint}") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise HeadbenchError(f"{command[0]}: {error}") from error
    return done.stdout
