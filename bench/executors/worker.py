"""What a process or a job does: work on one cell of a run folder and leave its rows and its outcome there."""

from __future__ import annotations

import errno
import logging
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError

if TYPE_CHECKING:
    from ..contracts import Clip
    from ..protocol import Protocol
    from ..runner.config import ResolvedMethod, RunConfig
    from ..runner.steps import Job
    from ..runner.store import RunFolder
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
        self._run: _Run | None = None
        self._clips: list[Clip] = []
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
            "threads": os.environ.get("OMP_NUM_THREADS", ""),
            "machine": self._machine,
        }
        with output_inside(run), locked(cell), _output_to(cell / JOB_LOG), log_to_file(cell / JOB_LOG):
            before = 0.0
            first = read_outcome(cell) if work.speed else None
            if first is not None and not first["speed"]:
                before = first.get("seconds", 0.0)
                outcome["restarts"] += first.get("restarts", 0)
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

        job = self._job(work)
        assert self._run is not None
        metrics = self._run.metrics
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
        from ..runner.captures import open_clips
        from ..runner.run import make_jobs

        if self._run is None or self._run.folder.root != Path(work.run):
            self._run = _Run.read(Path(work.run))
            self._clips = []
        config, recorded = self._run.config, self._run.fingerprints
        if [clip.subject for clip in self._clips] != [work.subject]:
            self._clips = []  # the former, before another takes memory
            self._clips = open_clips(config, only=work.capture)
        if {clip.subject: clip.fingerprint for clip in self._clips} != {work.subject: recorded[work.subject]}:
            found = ", ".join(clip.subject for clip in self._clips) or "none"
            raise InputError(config.data, work.subject, "the capture that the run began with", found)
        methods, chosen = [self._run.methods[work.method]], replace(config, seeds=(work.seed,))
        return make_jobs(chosen, methods, self._clips, self._run.protocols, self._run.folder)[0]


@dataclass(frozen=True)
class _Run:
    """A run as its record has it."""

    folder: RunFolder
    config: RunConfig
    fingerprints: Mapping[str, str]
    methods: Mapping[str, ResolvedMethod]
    metrics: Sequence[MetricSpec]
    protocols: Mapping[str, Protocol]

    @classmethod
    def read(cls, root: Path) -> _Run:
        from ..machine import check_device
        from ..protocol import Protocol
        from ..runner.config import resolve_methods, resolve_metrics
        from ..runner.store import RunFolder

        folder = RunFolder(root)
        manifest = folder.read_manifest()
        config = replace(manifest.configuration, out=str(root))
        check_device(config.device)
        protocols = {}
        for task, record in manifest.protocols.items():
            protocols[task] = Protocol(**{f.name: getattr(record, f.name) for f in fields(Protocol)})
            if protocols[task].hash != record.hash:
                raise InputError(folder.manifest, f"protocols.{task}", record.hash, protocols[task].hash)
        return cls(
            folder,
            config,
            {clip.subject: clip.fingerprint for clip in manifest.clips},
            {method.spec.name: method for method in resolve_methods(config)},
            resolve_metrics(config),
            protocols,
        )


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
