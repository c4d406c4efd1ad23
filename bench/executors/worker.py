"""What a process or a job does: work on one cell of a run folder and leave its rows and its outcome there."""

from __future__ import annotations

import errno
import logging
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError

if TYPE_CHECKING:
    from ..runner.steps import Job
    from ..specs import MetricSpec
    from .outcome import Outcome

log = logging.getLogger(__name__)
JOB_LOG = "job.log"
REPORT_EVERY_S = 10.0
"""Seconds between records of how far a cell is."""
FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""Errors of the system that no other cell would be spared."""


@dataclass(frozen=True)
class Work:
    """One cell to work on, as a process or a job is told.

    Attributes
    ----------
    run : absolute path of the run folder, whose record has the settings.
    directory, path : working directory and module path of the process that asks, where plug-ins are found.
    capture : index of the subject's capture among those that the reader finds.
    speed : also measure speed, which takes a machine without neighbours; otherwise all but that.
    restarts : how often the cell was started again, its earlier process or job being lost.
    """

    run: str
    directory: str
    path: tuple[str, ...]
    subject: str
    method: str
    seed: int
    capture: int
    speed: bool
    restarts: int = 0

    @property
    def cell(self) -> str:
        """Place of the cell in the run folder."""
        return f"{self.subject}/{self.method}/seed-{self.seed}"

    def __call__(self) -> None:
        """Do it, in a job of its own. Raises what a cell cannot be recorded as failed for."""
        os.chdir(self.directory)
        sys.path += [entry for entry in self.path if entry not in sys.path]
        Worker().work(self)

    def checkpoint(self) -> Any:
        """What submitit submits again where a job runs out of time: the same, which continues."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def is_speed(metric: MetricSpec) -> bool:
    """Whether neighbours on the machine would change what a metric of an avatar measures."""
    return metric.machine_bound and metric.kind == "avatar"


class Worker:
    """Works on cells, one after another, and keeps the capture opened last, since cells of a subject follow each other."""

    def __init__(self) -> None:
        self._opened: tuple[tuple[str, int], Callable[[Work], Job]] | None = None
        self._machine: dict[str, Any] | None = None

    def work(self, work: Work) -> None:
        """Train, render and measure a cell. What fails is recorded in ``outcome.json``, with its log in ``job.log``.

        Raises
        ------
        InputError : another process works on the cell.
        OSError : the disk is full or read-only.
        """
        from ..io.files import output_inside
        from ..io.lock import locked
        from ..machine import machine_record
        from ..progress import log_to_file
        from ..runner.steps import reason_of
        from ..runner.store import RunFolder
        from .outcome import read_outcome, write_outcome

        run = Path(work.run)
        cell = RunFolder(run).cell(work.subject, work.method, work.seed).folder
        self._machine = self._machine or machine_record()
        start = time.monotonic()
        outcome: Outcome = {
            "status": "running",
            "speed": work.speed,
            "doing": "starting",
            "since": datetime.now(UTC).isoformat(timespec="seconds"),
            "restarts": work.restarts + int(os.environ.get("SLURM_RESTART_COUNT", "0")),
            "job": job_id(),
            "process": os.getpid(),
            "host": platform.node(),
            "machine": self._machine,
        }
        with output_inside(run), locked(cell), _output_to(cell / JOB_LOG), log_to_file(cell / JOB_LOG):
            earlier = read_outcome(cell) if work.speed else None
            before = 0.0 if earlier is None else earlier.get("seconds", 0.0)
            write_outcome(cell, outcome)
            try:
                self._measure(work, lambda doing: write_outcome(cell, {**outcome, "doing": doing}))
                ended: Outcome = {**outcome, "status": "done"}
            except OSError as error:
                if error.errno in FULL_DISK:
                    raise
                log.exception("failed")
                ended = {**outcome, "status": "failed", "reason": reason_of(error)}
            except Exception as error:
                log.exception("failed")
                ended = {**outcome, "status": "failed", "reason": reason_of(error)}
            del ended["doing"]
            write_outcome(cell, {**ended, "seconds": round(before + time.monotonic() - start, 3)})

    def _measure(self, work: Work, report: Callable[[str], None]) -> None:
        from ..progress import RunProgress
        from ..runner.steps import fit, measure, measured, render, steps_ahead

        job, metrics = self._job(work), self._metrics
        last = time.monotonic()

        def show(text: Callable[[], str]) -> None:
            nonlocal last
            if time.monotonic() - last > REPORT_EVERY_S:
                last = time.monotonic()
                log.info("%s", words := text().partition(": ")[2])
                report(words)

        job = replace(job, line=RunProgress({job.name: steps_ahead(job, metrics)}, show))
        avatar = fit(job)
        render(job, avatar)
        if not work.speed:
            kept = measured(job, metrics)
            metrics = [metric for metric in metrics if metric in kept or not is_speed(metric)]
        measure(job, avatar, metrics)

    def _job(self, work: Work) -> Job:
        key = work.run, work.capture
        if self._opened is None or self._opened[0] != key:
            self._opened = None
            self._opened = key, self._open(work)
        return self._opened[1](work)

    def _open(self, work: Work) -> Callable[[Work], Job]:
        """Open the capture of a cell, by the record of its run; return what makes the subject's cells."""
        from ..machine import check_device
        from ..protocol import Protocol
        from ..runner.captures import open_clips
        from ..runner.config import resolve_methods, resolve_metrics
        from ..runner.run import make_jobs
        from ..runner.store import RunFolder

        folder = RunFolder(Path(work.run))
        manifest = folder.read_manifest()
        config = replace(manifest.configuration, out=work.run)
        check_device(config.device)
        clips = open_clips(config, only=work.capture)
        recorded = {clip.subject: clip.fingerprint for clip in manifest.clips}
        if {clip.subject: clip.fingerprint for clip in clips} != {work.subject: recorded.get(work.subject)}:
            found = ", ".join(clip.subject for clip in clips) or "none"
            raise InputError(config.data, work.subject, "the capture that the run began with", found)
        protocols = {}
        for task, record in manifest.protocols.items():
            protocols[task] = Protocol(**{f.name: getattr(record, f.name) for f in fields(Protocol)})
            if protocols[task].hash != record.hash:
                raise InputError(folder.manifest, f"protocols.{task}", record.hash, protocols[task].hash)
        methods = {method.spec.name: method for method in resolve_methods(config)}
        self._metrics = resolve_metrics(config)

        def job(work: Work) -> Job:
            chosen = replace(config, seeds=(work.seed,))
            return make_jobs(chosen, [methods[work.method]], clips, protocols, folder)[0]

        return job


def job_id() -> str:
    """Number of the job of Slurm that this process is, "" for none."""
    array, task = (os.environ.get(f"SLURM_ARRAY_{part}") for part in ("JOB_ID", "TASK_ID"))
    return f"{array}_{task}" if array and task else os.environ.get("SLURM_JOB_ID", "")


@contextmanager
def _output_to(path: Path) -> Iterator[None]:
    """Send what the process and its children print, native code included, to a log while the block runs."""
    from ..io.files import no_link

    sys.stdout.flush()
    sys.stderr.flush()
    before = [os.dup(number) for number in (1, 2)]
    with open(path, "a", encoding="utf-8", opener=no_link) as stream:
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
