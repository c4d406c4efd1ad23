"""Runs the cells of a run with an executor, in workers or as jobs, and merges their rows.

Two passes: all cells in parallel, then the speed of their avatars, without concurrent jobs that would bias
it. The state of a cell is stored in its files; only this process writes the files of the run.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..condition import Condition, label_of
from ..contracts import Clip
from ..errors import InputError, shortened
from ..executors.outcome import read_outcome
from ..executors.schedule import DAMAGED, Failures, Schedule
from ..executors.settings import Execution, is_speed
from ..executors.task import Task
from ..io.documents import checked, read_json
from ..io.files import write_json
from ..live import Position
from ..machine import check_device
from ..progress import RunProgress
from ..protocol import Protocol
from ..rows import Rows
from ..specs import MAX_LABEL, MetricSpec
from .captures import open_clips
from .config import ResolvedMethod, RunConfig, resolve_cells, resolve_metrics
from .job import Job, trained_files
from .jobs import make_jobs, run_cell, steps_ahead
from .measuring import failed_rows, stored_rows
from .store import RunFolder
from .training import log_kept

log = logging.getLogger(__name__)
REPORT_EVERY_S, LOG_EVERY_S = 2.0, 10.0
"""Seconds between progress records of a cell, shown in a terminal, and between lines of its log."""
UNTRAINED_COST = 0.15
"""Expected time of a cell without training (baselines, derived avatars), relative to one with training."""


def execute(
    jobs: Sequence[Job], metrics: Sequence[MetricSpec], folder: RunFolder, execution: Execution
) -> Rows:
    """Execute the cells of a run, which the caller has locked and recorded; return the rows of all.

    Finished cells are kept. A cell whose process or job was lost is restarted, at most `Execution.restarts`
    times. A cell that fails has failed rows. A restarted run repeats failed cells, unless it had begun to
    measure speed; it then continues with that.
    """
    captures = {subject: index for index, subject in enumerate(dict.fromkeys(j.clip.subject for j in jobs))}
    tasks = [cell_task(job, captures[job.clip.subject], folder) for job in jobs]
    places = {task.place: job for task, job in zip(tasks, jobs)}
    steady = [metric for metric in metrics if not is_speed(metric)]

    for job in jobs:
        if job.cell.is_done("fit", job.fit_fingerprint) and not job.cell.damage(trained_files(job)):
            log_kept(job)

    def left(wanted: Sequence[MetricSpec], follows: Sequence[bool] = (False, True)) -> list[Task]:
        return [
            task
            for task in tasks
            if task.place not in failures
            and places[task.place].follows in follows
            and stored_rows(places[task.place], wanted, retry=True) is None
        ]

    failures = _failed_before(folder)
    schedule = Schedule(
        "avatars trained and measured",
        lambda task: stored_rows(places[task.place], steady) is not None,
        execution,
    )
    for follows in (False, True):  # derived avatars wait for the training of their source
        failures |= schedule.run_all(left(steady, (follows,)))
    if len(steady) < len(metrics):
        write_json(folder.speed_pass, {"failed": failures})
        whole = replace(
            schedule,
            label="speed of avatars measured",
            is_done=lambda task: stored_rows(places[task.place], metrics) is not None,
            speed=True,
        )
        failures |= whole.run_all([replace(task, speed=True) for task in left(metrics)])
    return Rows.joined(_merged(job, metrics, failures.get(place)) for place, job in places.items())


def _failed_before(folder: RunFolder) -> Failures:
    """Cells that had failed, with reasons, when the run was killed during the speed measurement."""
    path = folder.speed_pass
    return checked(read_json(path), dict[str, Failures], path)["failed"] if path.exists() else {}


def _merged(job: Job, metrics: Sequence[MetricSpec], failure: str | None) -> Rows:
    """Rows of a cell that has ended."""
    rows = stored_rows(job, metrics) if failure is None else None
    return failed_rows(job, metrics, failure or f"HeadbenchError: {DAMAGED}") if rows is None else rows


def machine_of(jobs: Sequence[Job], otherwise: Mapping[str, Any]) -> Mapping[str, Any]:
    """The machine that ran the cells; ``otherwise`` if none is recorded; all names if there were several."""
    outcomes = [read_outcome(job.cell.folder) for job in jobs]
    machines = [outcome["machine"] for outcome in outcomes if outcome is not None and "machine" in outcome]
    if not machines:
        return otherwise
    record = {**machines[0], "processor": _all_of(str(machine.get("processor")) for machine in machines)}
    devices = [machine["device"] for machine in machines if "device" in machine]
    if devices:
        record["device"] = {**devices[0], "name": _all_of(str(device["name"]) for device in devices)}
    return record


def _all_of(names: Iterable[str]) -> str:
    """Join distinct names; log a warning if there are several."""
    different = sorted(set(names))
    if len(different) > 1:
        log.warning(
            "Cells were executed by %s: their times and speeds are not comparable.", ", ".join(different)
        )
    return shortened(" and ".join(different), MAX_LABEL - 10)


def cell_task(job: Job, capture: int, folder: RunFolder) -> Task:
    """The task of a cell of the run in ``folder``; ``capture`` is the index of its subject among the captures found."""
    place = job.cell.folder.relative_to(folder.root).as_posix()
    cell = {"subject": job.clip.subject, "label": job.label, "seed": job.seed, "capture": capture}
    task = Task.of(folder.root, place, f"{__name__}:execute_cell", **cell)
    trains = job.source is None and not job.method.spec.trivial
    return replace(task, device=job.device, name=job.name, cost=1.0 if trains else UNTRAINED_COST)


def execute_cell(task: Task, report: Callable[[str], None]) -> None:
    """Run a cell as recorded in its run, without speed metrics unless the task measures speed."""
    job, metrics = _opened.job(Path(task.root), **task.arguments)
    reported = logged = time.monotonic()

    def show(position: Callable[[], Position]) -> None:
        nonlocal reported, logged
        now = time.monotonic()
        if now - reported < REPORT_EVERY_S:
            return
        reported, words = now, position().text.partition(": ")[2]
        report(words)
        if now - logged >= LOG_EVERY_S:
            logged = now
            log.info("%s", words)

    job = replace(job, line=RunProgress({job.name: steps_ahead(job, metrics)}, show))
    run_cell(job, metrics if task.speed else [metric for metric in metrics if not is_speed(metric)])


class _Opened:
    """Cache of the last run record and capture, since cells of the same run and subject follow each other."""

    def __init__(self) -> None:
        self._run: _Run | None = None
        self._clips: list[Clip] = []

    def job(
        self, run: Path, subject: str, label: str, seed: int, capture: int
    ) -> tuple[Job, Sequence[MetricSpec]]:
        """A cell and the metrics of its run. Raises `InputError` if the capture has changed since the run began."""
        if self._run is None or self._run.folder.root != run:
            self._run = _Run.read(run)
            self._clips = []
        config, recorded = self._run.config, self._run.fingerprints
        if [clip.subject for clip in self._clips] != [subject]:
            self._clips = []  # free the former before reading another
            self._clips = open_clips(config, only=capture)
        if {clip.subject: clip.fingerprint for clip in self._clips} != {subject: recorded[subject]}:
            found = ", ".join(clip.subject for clip in self._clips) or "none"
            raise InputError(config.data, subject, "the capture that the run began with", found)
        cells, chosen = [self._run.cells[label]], replace(config, seeds=(seed,))
        (job,) = make_jobs(chosen, cells, self._clips, self._run.protocols, self._run.folder)
        return job, self._run.metrics


_opened = _Opened()


@dataclass(frozen=True)
class _Run:
    """A run as recorded."""

    folder: RunFolder
    config: RunConfig
    fingerprints: Mapping[str, str]
    cells: Mapping[str, tuple[ResolvedMethod, Condition]]
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
        cells = {
            label_of(m.spec.name, condition.name): (m, condition) for m, condition in resolve_cells(config)
        }
        began_with = {method.label: method.code for method in manifest.methods}
        for label, (method, _) in cells.items():
            code = method.identity().get("code")  # for plug-ins outside the package
            if code not in (None, began_with.get(label)):
                expected = f"{began_with.get(label)}, the digest of the plug-in's code when the run began"
                raise InputError(folder.manifest, f"methods, code of {label}", expected, code)
        return cls(
            folder,
            config,
            {clip.subject: clip.fingerprint for clip in manifest.clips},
            cells,
            resolve_metrics(config),
            protocols,
        )
