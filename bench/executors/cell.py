"""The task of one cell of a run: train, render, measure. What it measured is in the cell's own files."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ..contracts import Clip
from ..errors import InputError
from ..machine import check_device
from ..progress import RunProgress
from ..protocol import Protocol
from ..runner.captures import open_clips
from ..runner.config import ResolvedMethod, RunConfig, resolve_methods, resolve_metrics
from ..runner.run import make_jobs
from ..runner.steps import Job, fit, measure, render, steps_ahead
from ..runner.store import RunFolder
from ..specs import MetricSpec
from .settings import is_speed
from .task import Task

log = logging.getLogger(__name__)
REPORT_EVERY_S = 10.0
"""Seconds between records of how far a cell is."""


def cell_task(job: Job, capture: int, folder: RunFolder) -> Task:
    """The task of a cell of the run in ``folder``; ``capture`` is the index of its subject's among those that the reader finds."""
    place = job.cell.folder.relative_to(folder.root).as_posix()
    cell = {"subject": job.clip.subject, "method": job.method.spec.name, "seed": job.seed, "capture": capture}
    return replace(Task.of(folder.root, place, f"{__name__}:run_cell", **cell), device=job.device)


def run_cell(task: Task, report: Callable[[str], None]) -> None:
    """Train, render and measure a cell by the record of its run; all but its speed, unless the task is to measure that."""
    job, metrics = _opened.job(Path(task.root), **task.arguments)
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
    measure(job, avatar, metrics if task.speed else [metric for metric in metrics if not is_speed(metric)])


class _Opened:
    """The record and the capture that were read last: cells of a run and of a subject follow each other."""

    def __init__(self) -> None:
        self._run: _Run | None = None
        self._clips: list[Clip] = []

    def job(
        self, run: Path, subject: str, method: str, seed: int, capture: int
    ) -> tuple[Job, Sequence[MetricSpec]]:
        """A cell and the metrics of its run. Raises `InputError` for another capture than the run began with."""
        if self._run is None or self._run.folder.root != run:
            self._run = _Run.read(run)
            self._clips = []
        config, recorded = self._run.config, self._run.fingerprints
        if [clip.subject for clip in self._clips] != [subject]:
            self._clips = []  # the former, before another takes memory
            self._clips = open_clips(config, only=capture)
        if {clip.subject: clip.fingerprint for clip in self._clips} != {subject: recorded[subject]}:
            found = ", ".join(clip.subject for clip in self._clips) or "none"
            raise InputError(config.data, subject, "the capture that the run began with", found)
        methods, chosen = [self._run.methods[method]], replace(config, seeds=(seed,))
        (job,) = make_jobs(chosen, methods, self._clips, self._run.protocols, self._run.folder)
        return job, self._run.metrics


_opened = _Opened()


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
        folder = RunFolder(root)
        manifest = folder.read_manifest()
        config = replace(manifest.configuration, out=str(root))
        check_device(config.device)
        recorded = manifest.protocols.items()
        protocols = {task: record.protocol(folder.manifest) for task, record in recorded}
        methods = {method.spec.name: method for method in resolve_methods(config)}
        began_with = {method.name: method.code for method in manifest.methods}
        for name, method in methods.items():
            code = method.identity().get("code")  # of a plug-in outside the package
            if code not in (None, began_with.get(name)):
                expected = f"{began_with.get(name)}, the digest of the plug-in's code when the run began"
                raise InputError(folder.manifest, f"methods, code of {name}", expected, code)
        return cls(
            folder,
            config,
            {clip.subject: clip.fingerprint for clip in manifest.clips},
            methods,
            resolve_metrics(config),
            protocols,
        )
