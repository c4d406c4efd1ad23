"""Runs a comparison: plans it, which checks everything, then works on it cell by cell, then reports.

With the executor ``inline``, cells follow each other in this process. The others have two passes: all cells in parallel, then the
speed of their avatars, without concurrent jobs that would bias it. The state of a cell is stored in its files; only this process
writes the files of the run.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from ..condition import Condition, label_of
from ..contracts import Clip
from ..errors import HeadbenchError, InputError, LeftOutError, UnavailableError, reason_of, shortened
from ..executors.settings import Execution, check_executor
from ..io.files import FULL_DISK, check_kind, check_output_folder
from ..io.lock import locked
from ..machine import (
    check_device,
    check_device_answers,
    memory,
    peak_memory_bytes,
    processor_count,
)
from ..progress import Position, RunProgress, counted, duration, run_progress
from ..protocol import TASK_TITLES, Protocol, missing_tasks
from ..registry import discover, get, resolve
from ..rows import Rows
from ..specs import MAX_LABEL, DatasetSpec, MetricSpec
from .captures import located, open_clips
from .cell import failed_rows, kept_rows, log_kept, run_cell
from .config import ResolvedMethod, RunConfig, resolve_cells, resolve_metrics
from .plan import Job, Plan, make_jobs, make_plan
from .scoring import compared_over_time, make_metric
from .store import FinishedRun, RunFolder, read_outcome

if TYPE_CHECKING:
    from ..executors.task import Task

WORKER_BYTES = 2_000_000_000
"""Memory that a worker may need, for the executor ``auto``."""
log = logging.getLogger(__name__)
RunCell = Callable[[Job, Sequence[MetricSpec]], Rows]
REPORT_EVERY_S, LOG_EVERY_S = 2.0, 10.0
"""Seconds between progress records of a cell, shown in a terminal, and between lines of its log."""
UNTRAINED_COST = 0.15
"""Expected time of a cell without training (baselines, derived avatars), relative to one with training."""


def run(
    config: RunConfig,
    execution: Execution | None = None,
    *,
    unchecked: bool = False,
    clips: Sequence[Clip] | None = None,
    cells: Sequence[tuple[ResolvedMethod, Condition]] | None = None,
    metrics: Sequence[MetricSpec] | None = None,
    each: RunCell = run_cell,
    is_locked: bool = False,
    reports: bool = True,
    **record: Any,
) -> FinishedRun:
    """Run the cells of a configuration into ``config.out``.

    Everything that can be checked is checked before the first long step: settings, device, methods, captures,
    the output folder, and that no other process uses it. A method that fails is recorded as failed and the
    others continue. The same configuration continues a run: finished cells are kept, interrupted ones resume, failed ones are
    repeated. Another configuration is refused.

    Parameters
    ----------
    execution : Execution, optional
        How to execute the cells. Default: sequentially in this process.
    unchecked : bool
        Do not search the captures for errors that change results (see `DatasetSpec.errors`). A run is
        continued without a search, too.
    clips : Sequence[Clip], optional
        Captures of the configuration, if they are already open.
    cells, metrics : sequence, optional
        Resolved cells and metrics, if the configuration does not name them; they require ``each``.
    each : callable, optional
        Executes a cell in this process.
    is_locked : bool
        Whether the caller has locked the folder.
    reports : bool
        Write the registered reports at the end.
    record : Any
        Values to add to the manifest.
    """
    start = time.perf_counter()
    config, execution = located(config), execution or Execution()
    root = Path(config.out)
    check_kind(root, "a run")
    check_output_folder(root)
    with nullcontext() if is_locked else locked(root):
        check_executor(execution, config.device)
        plan = make_plan(config, clips, cells, metrics)
        folder, jobs, metrics = plan.folder, plan.jobs, plan.metrics
        unchecked = _check_captures(plan, unchecked)
        manifest = replace(plan.manifest, unchecked=unchecked or None, **record)
        manifest.write(folder.manifest)
        parts = []
        execution = chosen(execution, plan)
        if execution.executor == "inline":
            with run_progress({job.name: job.steps(metrics) for job in jobs}) as line:
                for job in jobs:
                    log.info("%s", job.name)
                    if read_outcome(job.cell.folder):  # of an earlier process or job
                        job.cell.update(task=None)
                    try:
                        parts.append(each(replace(job, line=line), metrics))
                    except Exception as error:  # noqa: BLE001 - a method may fail in any way; the others go on
                        _check_goes_on(job, error)
                        parts.append(failed_rows(job, metrics, reason_of(error)))
                    job.created.clear()  # so that a run does not keep every method in memory
        else:
            parts = execute(plan, execution)
            manifest = replace(manifest, machine=dict(_machine_of(jobs, manifest.machine)))
        rows = Rows.joined(parts)
        rows.write(folder.rows)
        seconds = round(time.perf_counter() - start, 3)
        methods = tuple(replace(method, codec=_codec(method.label, jobs)) for method in manifest.methods)
        manifest = replace(manifest, methods=methods, status="done", seconds=seconds)
        manifest = replace(manifest, peak_memory_bytes=peak_memory_bytes())
        manifest.write(folder.manifest)
        finished = FinishedRun(folder, manifest, rows, {clip.subject: clip for clip in plan.clips})
        if reports:
            log.info("writing tables, pictures and the report")
            write_reports(finished)
        log.info("finished in %s: %s", duration(time.perf_counter() - start), root)
        return finished


def planned_cells(config: RunConfig) -> dict[str, str]:
    """State of each cell that `run` would execute, with the same checks: done, trained, to train or to derive.

    Nothing is written into ``config.out``.
    """
    with TemporaryDirectory() as scratch:
        plan = make_plan(located(config), scratch=Path(scratch))
    return {job.name: _state(job, plan.metrics) for job in plan.jobs}


def _state(job: Job, metrics: Sequence[MetricSpec]) -> str:
    if not job.cell.is_trained:
        return "to train" if job.source is None else "to derive"
    return "done" if job.is_measured(metrics) else "trained"


def _check_captures(plan: Plan, unchecked: bool) -> bool:
    """Warn of what cannot be measured, and check the captures of a new run; return whether they are unchecked."""
    if plan.earlier is not None:
        unchecked = unchecked or bool(plan.earlier.unchecked)
    elif not unchecked and not plan.config.source:
        for clip in {job.clip.subject: job.clip for job in plan.jobs}.values():
            check_capture(plan.config, clip)
    if not plan.config.drive:
        warn_of_missing_metrics(plan.metrics, plan.clips[0])
        for reason in missing_tasks(plan.config.tasks, plan.protocols).values():
            log.warning("%s", reason)
    for protocol in plan.protocols.values():
        log.info("%s: %d frames to score", TASK_TITLES[protocol.task], len(protocol.keys))
    return unchecked


def _check_goes_on(job: Job, error: Exception) -> None:
    """Log the failure of a cell. Raises the error if it would affect every other cell."""
    if isinstance(error, OSError) and error.errno in FULL_DISK:
        raise error
    if isinstance(error, HeadbenchError):
        log.error("%s failed: %s", job.name, error)
        return
    log.error("%s failed", job.name, exc_info=error)
    check_device_answers(job.device)


def _codec(label: str, jobs: Sequence[Job]) -> str | None:
    """Codecs of the measured avatars of a method and condition, see `MethodRecord`."""
    records = [job.cell.record for job in jobs if job.label == label]
    codecs = {record["codec"] for record in records if "codec" in record}
    return "; ".join(sorted(codecs)) if codecs else None


def write_reports(run: FinishedRun) -> list[Path]:
    """Write every registered report of a finished run. One that fails is logged and the others are written.

    A full disk is an `OSError`.
    """
    written: list[Path] = []
    for name, plugin in discover("reports").items():
        if plugin.spec is None:
            log.warning("report %r of %s is broken: %s", name, plugin.origin, plugin.error)
        elif plugin.spec.writes:
            try:
                written += resolve(plugin.spec.implementation)(run)
            except (HeadbenchError, OSError) as error:
                if isinstance(error, OSError) and error.errno in FULL_DISK:
                    raise
                log.error("report %r of %s failed: %s; the rows are complete", name, plugin.origin, error)
            except Exception:
                log.exception("report %r of %s failed; the rows are complete", name, plugin.origin)
    return written


def warn_of_missing_metrics(metrics: Sequence[MetricSpec], clip: Clip) -> None:
    """Report unavailable metrics before the training."""
    image = clip.image(clip.splits["train"][0])
    for spec in metrics:
        metric = make_metric(spec)
        if not spec.per_frame:
            continue
        try:
            value = compared_over_time(metric, spec.kind)(image, image)
        except LeftOutError:
            continue
        except UnavailableError as error:
            log.warning("%s will be missing: %s", spec.label, error)
        else:
            if not np.isfinite(value):
                raise HeadbenchError(f"metric {spec.name} gives {value} for identical images")


def check_capture(config: RunConfig, clip: Clip) -> None:
    """Raise `InputError` for errors of a capture that change results, see `DatasetSpec.errors`."""
    spec: DatasetSpec = get("datasets", config.reader)
    errors = resolve(spec.errors)(clip) if spec.errors else []
    if errors:
        raise InputError(
            config.data,
            f"capture of {clip.subject}",
            "a capture without errors that change results",
            errors[0].rstrip(".")
            + (f"; and {counted(len(errors) - 1, 'other error')}" if errors[1:] else ""),
            "`headbench lint` shows more; `headbench run --unchecked` trains all the same.",
        )


def chosen(execution: Execution, plan: Plan) -> Execution:
    """Replace the executor ``auto``: a training keeps little more than one core busy, so several are executed at once.

    Not with limits in seconds, in which a training that shares the processor would do less.
    """
    if execution.executor != "auto":
        return execution
    trainings = [j for j in plan.jobs if not (j.source or j.method.spec.trivial or j.cell.is_trained)]
    workers = min(processor_count(), len(trainings), memory()[1] // WORKER_BYTES)
    is_timed = any(job.method.budget.seconds is not None for job in trainings)
    if plan.config.device != "cpu" or workers < 2 or is_timed:
        return replace(execution, executor="inline")
    log.info("%d trainings at once; --executor inline: one after another", workers)
    return replace(execution, executor="processes", workers=workers)


def execute(plan: Plan, execution: Execution) -> list[Rows]:
    """Execute the cells of a run in workers or as jobs; return the rows of each.

    Measured cells are kept. A cell whose process or job was lost is restarted, at most `Execution.restarts`
    times. A cell that fails has failed rows.
    """
    from ..executors.schedule import Schedule  # a run in this process needs no executor
    from ..executors.task import DAMAGED

    jobs, metrics = plan.jobs, plan.metrics
    captures = {subject: index for index, subject in enumerate(dict.fromkeys(j.clip.subject for j in jobs))}
    tasks = [_task(job, captures[job.clip.subject], plan.folder) for job in jobs]
    places = {task.place: job for task, job in zip(tasks, jobs)}
    steady = [metric for metric in metrics if not metric.is_speed]
    failures: dict[str, str] = {}
    for job in jobs:
        if job.is_measured(metrics):
            log_kept(job)
    schedule = Schedule(
        "avatars trained and measured", lambda task: places[task.place].is_measured(steady), execution
    )
    for follows in (False, True):  # derived avatars wait for the training of their source
        left = [t for t in tasks if places[t.place].follows == follows and not schedule.is_done(t)]
        failures |= schedule.run_all(left)
    if len(steady) < len(metrics):
        speed = Schedule(
            "speed of avatars measured",
            lambda task: places[task.place].is_measured(metrics),
            execution,
            speed=True,
        )
        left = [task for task in tasks if task.place not in failures and not speed.is_done(task)]
        failures |= speed.run_all([replace(task, speed=True) for task in left])
    parts = []
    for place, job in places.items():
        rows = None if place in failures else kept_rows(job, metrics)
        reason = failures.get(place, f"HeadbenchError: {DAMAGED}")
        parts.append(failed_rows(job, metrics, reason) if rows is None else rows)
    return parts


def _machine_of(jobs: Sequence[Job], otherwise: Mapping[str, Any]) -> Mapping[str, Any]:
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


def _task(job: Job, capture: int, folder: RunFolder) -> Task:
    """The task of a cell of the run in ``folder``; ``capture`` is the index of its subject among the captures found."""
    from ..executors.task import Task

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

    job = replace(job, line=RunProgress({job.name: job.steps(metrics)}, show))
    run_cell(job, metrics if task.speed else [metric for metric in metrics if not metric.is_speed])


class _Opened:
    """Cache of the last run record and capture, since cells of the same run and subject follow each other."""

    def __init__(self) -> None:
        self._run: _Run | None = None
        self._clips: list[Clip] = []

    def job(
        self, run: Path, subject: str, label: str, seed: int, capture: int
    ) -> tuple[Job, Sequence[MetricSpec]]:
        """A cell and the metrics of its run."""
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
